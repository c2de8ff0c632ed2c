"""Reads correction.json (docs/exporting.md) without bodyschema or numpy: readings in, true joint angles and pose out.

python correction.py correction.json < readings.txt    # readings in each line; prints the angles, then the pose
"""

import json
import math
import sys


class Correction:
    """True joint angles and marker pose of an arm from its readings, with the effects that bodyschema found."""

    def __init__(self, text):
        file = json.loads(text)
        if file.get("format") != "bodyschema correction 3":
            raise ValueError("not a correction of version 3: write it again with `bodyschema export`")
        self.joints, end = map(int, file["numbers"][:2])
        self.registers, self.runs = list(map(float, file["numbers"][:end])), []
        # The steps as functions of Python, made of these numbers alone: four times as fast as a call for each.
        steps, scope = zip(*[map(int, file["numbers"][end:])] * 5, strict=True), {**vars(math), "remember": remember}
        lines = [STEPS[step].format(to=to, a=a, b=b, c=self.registers[c : c + 13]) for step, to, a, b, c in steps]
        for k in range(0, len(lines), 50):  # compiling longer functions takes memory without limit
            exec("\n ".join(["def run(r):", *lines[k : k + 50]]), scope)
            self.runs.append(scope["run"])

    def read(self, q, pace=1.0):
        """Return true joint angles, and the marker's pose (3 rows of 4) in the measurement frame, at the next readings.

        pace: time since the last readings, as a multiple of the usual one; None after an interruption. A reading that
        is not finite makes what depends on it NaN, and is not remembered.
        """
        r, d, q = self.registers, self.joints, [reading if math.isfinite(reading) else math.nan for reading in q]
        if len(q) != d:
            raise ValueError("another number of readings than of joints")
        r[2], r[15 + d : 15 + 2 * d] = -1.0 if pace is None else pace, q
        for run in self.runs:
            run(r)
        return r[15 : 15 + d], r[3:15]


def remember(r, to, reading, pace, kind, scale):
    """Set a strain (0 play, 1 hysteresis, 2 settling), its last reading, and how far it has begun."""
    (strain, last, begun), now = r[to : to + 3], r[reading]
    move = now - last if begun else 0.0
    way, left = math.copysign(1.0, move), 1.0 - math.copysign(1.0, move) * strain if begun > 1 else 0.0
    if kind == 2:
        strain = 0.0 if r[pace] < 0 else move + math.copysign(abs(scale) ** r[pace], scale) * strain
    elif move:  # the first shows the side
        strain = way * (1.0 - (left * math.exp(-abs(move) / scale) if kind else max(left - abs(move) / scale, 0.0)))
    if math.isfinite(now):
        r[to : to + 3] = strain, now, 2 if move else max(begun, 1)


ADD = "r[{to}] = r[{a}] + {c[0]} * r[{b}]"
ADD_THREE = "; ".join(f"r[{{to}} + {k}] = r[{{a}} + {k}] + {{c[0]}} * r[{{b}} + {k}]" for k in range(3))
WAVE = "r[{to}] = r[{a}] + {c[0]} * sin({c[1]} * r[{b}] + {c[2]})"
MEMORY = "remember(r, {to}, {a}, {b}, {c[0]}, {c[1]})"
TORQUE = "r[{to}] = r[{a} + 3] * r[{b} + 2] if {c[0]} else r[{a}] * r[{b} + 1] - r[{a} + 1] * r[{b}]"
SIDE = "r[{to}] = (-1.0 if r[{a}] < 0.0 else 1.0) if abs(r[{a}]) > ({c[0]} if r[{b}] else -1.0) else r[{b}]"
MOTION = "u, v, s = (1.0, 0.0, r[{b}]) if {c[0]} else (cos(r[{b}]), sin(r[{b}]), 0.0); "
# What a body weighs, (mass times place, mass), as its parent has it.
INWARDS = MOTION + (
    "x, y, z, w = r[{a}], r[{a} + 1], r[{a} + 2], r[{a} + 3]; x, y, z = u * x - v * y, v * x + u * y, z + s * w; "
    "r[{to}] = {c[1]} * x + {c[2]} * y + {c[3]} * z + {c[4]} * w; "
    "r[{to} + 1] = {c[5]} * x + {c[6]} * y + {c[7]} * z + {c[8]} * w; "
    "r[{to} + 2] = {c[9]} * x + {c[10]} * y + {c[11]} * z + {c[12]} * w; "
)
# A row of a pose, as the next joint's.
ROW = (
    "x, y, z, w = r[{a}:{a} + 4]; x, y, z, w = {c[1]} * x + {c[5]} * y + {c[9]} * z, "
    "{c[2]} * x + {c[6]} * y + {c[10]} * z, {c[3]} * x + {c[7]} * y + {c[11]} * z, "
    "w + {c[4]} * x + {c[8]} * y + {c[12]} * z; r[{to}:{to} + 4] = u * x + v * y, u * y - v * x, z, w + s * z; "
)
ROWS = [ROW.replace("{a}", f"{{a}} + {k}").replace("{to}", f"{{to}} + {k}") for k in (0, 4, 8)]
STEPS = ADD, ADD_THREE, WAVE, MEMORY, TORQUE, SIDE, INWARDS, MOTION + ROW, None, MOTION + "".join(ROWS)

if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as stream:
        correction = Correction(stream.read())
    for line in (each for each in sys.stdin if each.strip(" \t\r\n\v\f,")):
        if set("_\x1c\x1d\x1e\x1f") & set(line) or not line.isascii():  # Python alone reads 1_000, and other scripts
            raise ValueError(f"not numbers: {line}")
        print(*(x for part in correction.read(map(float, line.replace(",", " ").split())) for x in part))
