"""Reads correction.json (docs/exporting.md) without bodyschema or numpy: readings in, true joint angles and pose out.

python correction.py correction.json < readings.txt    # readings in each line; prints the angles, then the pose
"""

import json
import sys
from functools import partial
from math import copysign, cos, exp, isfinite, nan, sin


class Correction:
    """True joint angles and marker pose of an arm from its readings, with the effects that bodyschema found."""

    def __init__(self, text):
        file = json.loads(text)
        if file.get("format") != "bodyschema correction 3":
            raise ValueError("not a correction of version 3: write it again with `bodyschema export`")
        self.joints, end = file["numbers"][:2]
        self.registers, numbers = file["numbers"][:end], file["numbers"][end:]
        steps = zip(*[iter(numbers)] * 5, strict=True)
        self.steps = [(STEPS[step], to, a, b, self.registers[c : c + 13]) for step, to, a, b, c in steps]

    def read(self, q, pace=1.0):
        """Return true joint angles, and the marker's pose (3 rows of 4) in the measurement frame, at the next readings.

        pace: time since the last readings, as a multiple of the usual one; None after an interruption. A reading that
        is not finite makes what depends on it NaN, and is not remembered.
        """
        r, d, q = self.registers, self.joints, [reading if isfinite(reading) else nan for reading in q]
        if len(q) != d:
            raise ValueError("another number of readings than of joints")
        r[2], r[15 + d : 15 + 2 * d] = -1.0 if pace is None else pace, q
        for step, to, a, b, c in self.steps:
            step(r, to, a, b, c)
        return r[15 : 15 + d], r[3:15]


def add(r, to, a, b, c):
    r[to] = r[a] + c[0] * r[b]


def add_three(r, to, a, b, c):
    r[to : to + 3] = r[a] + c[0] * r[b], r[a + 1] + c[0] * r[b + 1], r[a + 2] + c[0] * r[b + 2]


def wave(r, to, a, b, c):
    r[to] = r[a] + c[0] * sin(c[1] * r[b] + c[2])


def remember(r, to, reading, pace, c):
    """Set a strain (0 play, 1 hysteresis, 2 settling), its last reading, and how far it has begun."""
    (strain, last, begun), now, (kind, scale) = r[to : to + 3], r[reading], c[:2]
    move = now - last if begun else 0.0
    way, left = copysign(1.0, move), 1.0 - copysign(1.0, move) * strain if begun > 1 else 0.0
    if kind == 2:
        strain = 0.0 if r[pace] < 0 else move + copysign(abs(scale) ** r[pace], scale) * strain
    elif move:  # the first shows the side
        strain = way * (1.0 - (left * exp(-abs(move) / scale) if kind else max(left - abs(move) / scale, 0.0)))
    if isfinite(now):
        r[to : to + 3] = strain, now, 2 if move else max(begun, 1)


def torque(r, to, load, down, c):
    r[to] = r[load + 3] * r[down + 2] if c[0] else r[load] * r[down + 1] - r[load + 1] * r[down]


def side(r, to, torque, before, c):
    turns = abs(r[torque]) > (c[0] if r[before] else -1.0)
    r[to] = (-1.0 if r[torque] < 0.0 else 1.0) if turns else r[before]


def inwards(r, to, load, by, numbers):
    """Set what a body weighs, (mass times place, mass), as its parent has it."""
    (x, y, z, m), (slides, a, b, c, p, d, e, f, q, g, h, i, s) = r[load : load + 4], numbers
    u, v, z = (1.0, 0.0, z + r[by] * m) if slides else (cos(r[by]), sin(r[by]), z)
    x, y = u * x - v * y, v * x + u * y
    r[to : to + 3] = a * x + b * y + c * z + p * m, d * x + e * y + f * z + q * m, g * x + h * y + i * z + s * m


def outwards(r, to, row, by, numbers, places=(0,)):
    """Set rows of a pose to the next joint's."""
    slides, a, b, c, p, d, e, f, q, g, h, i, s = numbers
    u, v, shift = (1.0, 0.0, r[by]) if slides else (cos(r[by]), sin(r[by]), 0.0)
    for k in places:
        x, y, z, w = r[row + k : row + k + 4]
        w, x, y, z = w + p * x + q * y + s * z, a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z
        r[to + k : to + k + 4] = u * x + v * y, u * y - v * x, z, w + shift * z


STEPS = add, add_three, wave, remember, torque, side, inwards, outwards, None, partial(outwards, places=(0, 4, 8))

if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as stream:
        correction = Correction(stream.read())
    for line in filter(str.strip, sys.stdin):
        print(*(x for part in correction.read(map(float, line.replace(",", " ").split())) for x in part))
