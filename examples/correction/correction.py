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
        if (file.get("format"), file.get("version")) != ("bodyschema correction", 1):
            raise ValueError("not a correction of version 1")
        self.effects, joints = file["effects"], file["joints"]
        self.chain = [(k, joints[k]["parent"], joints[k]["slides"], joints[k]["pose"]) for k in file["outwards"]]
        self.ends = [(file[end]["parent"], file[end]["pose"]) for end in ("camera", "marker")]
        self.loose = [effect for effect in self.effects if effect["effect"] == "gravity_backlash"]
        self.springs = [(k, joint["compliance"]) for k, joint in enumerate(joints) if joint["compliance"]]
        self.masses = [(joint["mass_kg"], *joint["moment_kg_m"]) for joint in joints]
        self.gravity = file["gravity_m_s2"]

    def read(self, q, pace=1.0):
        """Return true joint angles, and the marker's pose (3 rows of 4) in the measurement frame, at the next readings.

        pace: time since the last readings, as a multiple of the usual one; None after an interruption.
        """
        unloaded = angles = [reading + 0.0 for reading in q]
        for effect in self.effects:
            angles[effect["joint"]] += self.error(effect, q, pace)
        frames = self.frames(angles)
        for _ in range(3 if self.springs else 0):  # what gives moves its own load
            torques, angles = self.torques(frames), list(unloaded)
            for k, compliance in self.springs:
                angles[k] += compliance * torques[k]
            frames = self.frames(angles)
        if self.loose:
            torques, angles = self.torques(frames), list(angles)
            for effect in self.loose:  # the state: the side on which the joint rests
                (width, hold), torque = effect["values"], torques[effect["joint"]]
                if not effect["state"] or abs(torque) > hold:
                    effect["state"][:] = [-1.0 if torque < 0.0 else 1.0]
                angles[effect["joint"]] += 0.5 * width * effect["state"][0]
            frames = self.frames(angles)
        camera, marker = (product(frames[parent], pose) for parent, pose in self.ends)
        a, b, c, x, d, e, f, y, g, h, i, z = camera
        back = (a, d, g, -a * x - d * y - g * z, b, e, h, -b * x - e * y - h * z, c, f, i, -c * x - f * y - i * z)
        return angles, product(back, marker)

    def error(self, effect, q, pace):
        """Return the error that an effect adds to the reading of its joint."""
        kind, values, state, reading = effect["effect"], effect["values"], effect["state"], q[effect["joint"]]
        if kind == "joint_offset":
            return values[0]
        if kind == "joint_scale":
            return values[0] * reading
        if kind == "joint_coupling":
            return values[0] * q[effect["source"]]
        if kind == "joint_eccentricity":
            return math.asin(max(-0.95, min(0.95, values[0] * math.sin(reading) + values[1] * math.cos(reading))))
        if kind == "joint_ripple":
            return values[0] * math.sin(values[2] * reading) + values[1] * math.cos(values[2] * reading)
        if kind == "backlash":  # the state: where the joint is, and whether it has ever moved
            output, moved = state or (reading, False)
            half = 0.5 * values[0]
            if not moved and reading != output:  # it begins on the side to which its first move leads
                output, moved = output - math.copysign(half, reading - output), True
            state[:] = max(reading - half, min(reading + half, output)) if moved else output, moved
            return state[0] - reading
        if kind == "settling":  # the state: the last reading, and what was missing of it
            last, missing = state or (reading, 0.0)
            missing = 0.0 if pace is None else values[0] * (reading - last) + missing * values[1] ** pace
            state[:] = reading, missing
            return -missing
        if kind == "hysteresis":  # the state: the last reading, and the strain from -1 to 1; 0 until it has moved
            last, strain = state or (reading, 0.0)
            kept, way = math.exp(-abs(reading - last) / values[1]), math.copysign(1.0, reading - last)
            strain = strain if reading == last else way if strain == 0.0 else way * (1.0 - kept) + kept * strain
            state[:] = reading, strain
            return -values[0] * strain
        if kind == "gravity_backlash":  # it follows the load, after the springs
            return 0.0
        raise ValueError(f"unknown effect {kind}")

    def frames(self, angles):
        """Return frames of all joints in the root link's; the last is that link's own."""
        frames = [(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)] * (len(angles) + 1)
        for k, parent, slides, pose in self.chain:
            a, b, c, x, d, e, f, y, g, h, i, z = product(frames[parent], pose)
            if slides:
                s = angles[k]
                frames[k] = a, b, c, x + s * c, d, e, f, y + s * f, g, h, i, z + s * i
            else:
                u, v = math.cos(angles[k]), math.sin(angles[k])
                first = u * a + v * b, u * b - v * a, c, x, u * d + v * e, u * e - v * d, f, y
                frames[k] = *first, u * g + v * h, u * h - v * g, i, z
        return frames

    def torques(self, frames):
        """Return gravity's torque about each joint, or force along it."""
        mass, mx, my = ([0.0] * len(frames) for _ in range(3))
        torques = [0.0] * (len(frames) - 1)
        for k, parent, slides, _ in reversed(self.chain):
            a, b, c, x, d, e, f, y, *_, i, _ = frames[k]
            m, u, v, w = self.masses[k]
            mass[k] += m
            mx[k] += m * x + a * u + b * v + c * w
            my[k] += m * y + d * u + e * v + f * w
            arm = f * (mx[k] - mass[k] * x) - c * (my[k] - mass[k] * y)
            torques[k] = self.gravity * (-mass[k] * i if slides else arm)
            mass[parent], mx[parent], my[parent] = mass[parent] + mass[k], mx[parent] + mx[k], my[parent] + my[k]
        return torques


def product(P, Q):
    """Return the product of two poses."""
    a, b, c, x, d, e, f, y, g, h, i, z = P
    A, B, C, X, D, E, F, Y, G, H, J, Z = Q
    return (
        *(a * A + b * D + c * G, a * B + b * E + c * H, a * C + b * F + c * J, a * X + b * Y + c * Z + x),
        *(d * A + e * D + f * G, d * B + e * E + f * H, d * C + e * F + f * J, d * X + e * Y + f * Z + y),
        *(g * A + h * D + i * G, g * B + h * E + i * H, g * C + h * F + i * J, g * X + h * Y + i * Z + z),
    )


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as stream:
        correction = Correction(stream.read())
    for line in sys.stdin:
        angles, pose = correction.read([float(word) for word in line.split()])
        print(*angles, *pose)
