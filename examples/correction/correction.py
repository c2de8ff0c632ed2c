"""Reads correction.json (docs/exporting.md) without bodyschema or numpy: readings in, true joint angles and pose out.

python correction.py correction.json < readings.txt    # readings in each line; prints the angles, then the pose
"""

import json
import sys
from math import copysign, cos, exp, sin


class Correction:
    """True joint angles and marker pose of an arm from its readings, with the effects that bodyschema found."""

    def __init__(self, text):
        self.file = json.loads(text)
        if (self.file.get("format"), self.file.get("version")) != ("bodyschema correction", 2):
            raise ValueError("not a correction of version 2: write it again with `bodyschema export`")

    def read(self, q, pace=1.0):
        """Return true joint angles, and the marker's pose (3 rows of 4) in the measurement frame, at the next readings.

        pace: time since the last readings, as a multiple of the usual one; None after an interruption.
        """
        angles = list(self.file["zeros"])
        for joint, source, factor in self.file["ratios"]:
            angles[joint] += factor * q[source]
        for joint, amplitude, frequency, phase in self.file["waves"]:
            angles[joint] += amplitude * sin(frequency * q[joint] + phase)
        for joint, kind, amount, scale, state in self.file["memories"]:
            angles[joint] -= amount * strain(kind, scale, state, q[joint], pace)
        free = list(angles)
        for [loose] in self.file["passes"]:  # what gives moves its own load
            self.give_way(loose, free, angles)
        columns = self.file["marker"]
        for angle, (slides, pose) in zip(reversed(angles), reversed(self.file["chain"]), strict=True):
            columns = through(pose, slides, angle, columns)
        return angles, [number for row in list(zip(*columns, strict=True))[:3] for number in row]

    def give_way(self, loose, free, angles):
        """Let the springs yield to gravity, or all that is loose."""
        bodies, downs = self.file["bodies"], [self.file["gravity"]]
        for joint, parent, slides, (a, b, c, _, d, e, f, _, g, h, i, _), _, _ in bodies:
            (x, y, z), turn = downs[parent], 0.0 if slides else angles[joint]
            u, v, x, y, z = cos(turn), sin(turn), a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z
            downs.append((u * x + v * y, u * y - v * x, z))
        loads = [[0.0] * 4, *(body[4] for body in bodies)]  # mass times place, and mass
        for k in range(len(bodies), 0, -1):
            joint, parent, slides, pose, _, spring = bodies[k - 1]
            (compliance, half, hold, side), (a, b, _, mass), (x, y, z) = spring, loads[k], downs[k]
            torque = mass * z if slides else a * y - b * x
            [load] = through(pose, slides, angles[joint], loads[k : k + 1])
            loads[parent] = [own + more for own, more in zip(loads[parent], load, strict=True)]
            spring[3] = side if not loose or (side and abs(torque) <= hold) else -1.0 if torque < 0.0 else 1.0
            angles[joint] = angles[joint] + half * spring[3] if loose else free[joint] + compliance * torque


def strain(kind, scale, state, reading, pace):
    """Return the strain of a memory (0 play, 1 hysteresis, 2 settling) at its joint's next reading."""
    (begun, _, strain), move = state, reading - state[1] if state[0] else 0.0
    if kind == 2:
        strain = 0.0 if pace is None else move + copysign(abs(scale) ** pace, scale) * strain
    elif move:  # the first move shows the side
        way, x = copysign(1.0, move), abs(move) / scale
        left = 1.0 - way * strain if begun > 1 else 0.0
        strain = way * (1.0 - (left * exp(-x) if kind else max(left - x, 0.0)))
    state[:] = 2 if move else max(begun, 1), reading, strain
    return strain


def through(pose, slides, angle, vectors):
    """Return vectors (x, y, z, w) after a joint's motion, in the frame in which its own has this pose."""
    (a, b, c, p, d, e, f, q, g, h, i, r), turn, shift = pose, 0.0 if slides else angle, angle if slides else 0.0
    moved, u, v = [], cos(turn), sin(turn)
    for x, y, z, w in vectors:
        x, y, z = u * x - v * y, v * x + u * y, z + shift * w
        moved.append((a * x + b * y + c * z + p * w, d * x + e * y + f * z + q * w, g * x + h * y + i * z + r * w, w))
    return moved


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as stream:
        correction = Correction(stream.read())
    for line in sys.stdin:
        print(*(number for part in correction.read([float(word) for word in line.split()]) for number in part))
