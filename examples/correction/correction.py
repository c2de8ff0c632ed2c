"""Reads correction.json (docs/exporting.md) without bodyschema or numpy: readings in, true joint angles and pose out.

python correction.py correction.json < readings.txt    # readings in each line; prints the angles, then the pose
"""

import json
import sys
from math import copysign, cos, exp, isfinite, nan, sin


class Correction:
    """True joint angles and marker pose of an arm from its readings, with the effects that bodyschema found."""

    def __init__(self, text):
        self.file = json.loads(text)
        if (self.file.get("format"), self.file.get("version")) != ("bodyschema correction", 2):
            raise ValueError("not a correction of version 2: write it again with `bodyschema export`")

    def read(self, q, pace=1.0):
        """Return true joint angles, and the marker's pose (3 rows of 4) in the measurement frame, at the next readings.

        pace: time since the last readings, as a multiple of the usual one; None after an interruption. A reading that
        is not finite makes what depends on it NaN, and is not remembered.
        """
        angles, q = list(self.file["zeros"]), [reading if isfinite(reading) else nan for reading in q]
        if len(q) != len(angles):
            raise ValueError("another number of readings than of joints")
        for joint, source, factor in self.file["ratios"]:
            angles[joint] += factor * q[source]
        for joint, amplitude, frequency, phase in self.file["waves"]:
            angles[joint] += amplitude * sin(frequency * q[joint] + phase)
        for joint, kind, amount, scale, state in self.file["memories"]:
            angles[joint] -= amount * strain(kind, scale, state, q[joint], pace)
        free, loads, columns = list(angles), list(self.file["loads"]), self.file["marker"]
        for joint, body, parent, slides, pose in self.file["carried"]:
            carry(loads, body, parent, slides, pose, angles[joint])
        for loose, inside in self.file["passes"]:  # what gives moves its own load
            self.give_way(loose, inside, free, list(loads), angles)
        for angle, (slides, pose) in zip(reversed(angles), reversed(self.file["chain"]), strict=True):
            columns = through(pose, slides, angle, columns)
        return angles, [number for row in list(zip(*columns, strict=True))[:3] for number in row]

    def give_way(self, loose, inside, free, loads, angles):
        """Let the springs yield to gravity, or all that is loose."""
        downs = [self.file["gravity"]]
        for joint, parent, slides, (a, b, c, _, d, e, f, _, g, h, i, _), _ in self.file["bodies"]:
            (x, y, z), turn = downs[parent], 0.0 if slides else angles[joint]
            u, v, x, y, z = cos(turn), sin(turn), a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z
            downs.append((u * x + v * y, u * y - v * x, z))
        for body, (joint, parent, slides, pose, spring) in reversed(list(enumerate(self.file["bodies"], 1))[inside:]):
            (compliance, half, hold, side), (a, b, _, mass), (x, y, z) = spring, loads[body], downs[body]
            torque = mass * z if slides else a * y - b * x
            carry(loads, body, parent, slides, pose, angles[joint])
            spring[3] = (-1.0 if torque < 0.0 else 1.0) if loose and abs(torque) > (hold if side else -1.0) else side
            angles[joint] = angles[joint] + half * spring[3] if loose else free[joint] + compliance * torque


def carry(loads, body, parent, slides, pose, angle):
    """Add the load of a body to that of its parent."""
    [(x, y, z, mass)], (a, b, c, own) = through(pose, slides, angle, (loads[body],)), loads[parent]
    loads[parent] = a + x, b + y, c + z, own + mass


def strain(kind, scale, state, reading, pace):
    """Return the strain of a memory (0 play, 1 hysteresis, 2 settling) at its joint's next reading."""
    (begun, _, strain), move = state, reading - state[1] if state[0] else 0.0
    if kind == 2:
        strain = 0.0 if pace is None else move + copysign(abs(scale) ** pace, scale) * strain
    elif move:  # the first move shows the side
        x, left = abs(move) / scale, 1.0 - copysign(1.0, move) * strain if begun > 1 else 0.0
        strain = copysign(1.0, move) * (1.0 - (left * exp(-x) if kind else max(left - x, 0.0)))
    state[:] = (2 if move else max(begun, 1), reading, strain) if isfinite(reading) else state
    return strain


def through(pose, slides, by, vectors):
    """Yield vectors (x, y, z, w) after a joint's motion `by`, in the frame in which its own has this pose."""
    (a, b, c, p, d, e, f, q, g, h, i, r), (u, v, s) = pose, (1.0, 0.0, by) if slides else (cos(by), sin(by), 0.0)
    for x, y, z, w in vectors:
        x, y, z = u * x - v * y, v * x + u * y, z + s * w
        yield a * x + b * y + c * z + p * w, d * x + e * y + f * z + q * w, g * x + h * y + i * z + r * w, w


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as stream:
        correction = Correction(stream.read())
    for line in filter(str.strip, sys.stdin):
        print(*(x for part in correction.read(map(float, line.replace(",", " ").split())) for x in part))
