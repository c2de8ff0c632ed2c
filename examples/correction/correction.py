"""Reads correction.json (docs/exporting.md) without bodyschema or numpy: readings in, true joint angles and pose out.

python correction.py correction.json < readings.txt    # readings in each line; prints the angles, then the pose
"""

import json
import math
import sys

IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)


class Correction:
    """True joint angles and marker pose of an arm from its readings, with the effects that bodyschema found."""

    def __init__(self, text):
        file = json.loads(text)
        if (file.get("format"), file.get("version")) != ("bodyschema correction", 1):
            raise ValueError("not a correction of version 1")
        self.effects, joints, order = file["effects"], file["joints"], file["outwards"]
        self.joints = [(joint["slides"], joint["pose"]) for joint in joints]
        self.parents = [joint["parent"] for joint in joints]
        self.camera, self.marker = (
            (self.way_to(file[end]["parent"]), file[end]["pose"]) for end in ("camera", "marker")
        )
        self.loose = [effect for effect in self.effects if effect["effect"] == "gravity_backlash"]
        self.springs = [(k, joint["compliance"]) for k, joint in enumerate(joints) if joint["compliance"]]
        loaded = {k for k, _ in self.springs} | {effect["joint"] for effect in self.loose}
        self.inside = [(k, self.parents[k]) for k in order if any(k in self.way_to(each) for each in loaded)]
        self.outside = [k for k in reversed(order) if loaded & set(self.way_to(k))]
        self.moments = [joint["moment_kg_m"] for joint in joints]
        self.masses = [sum(joints[n]["mass_kg"] for n in order if k in self.way_to(n)) for k in range(len(joints))]
        self.gravity = (0.0, 0.0, -file["gravity_m_s2"])

    def way_to(self, joint):
        """Return the numbers of the joints from the root link to a joint, itself included."""
        return [] if joint < 0 else [*self.way_to(self.parents[joint]), joint]

    def read(self, q, pace=1.0):
        """Return true joint angles, and the marker's pose (3 rows of 4) in the measurement frame, at the next readings.

        pace: time since the last readings, as a multiple of the usual one; None after an interruption.
        """
        angles = [reading + 0.0 for reading in q]
        for effect in self.effects:
            angles[effect["joint"]] += self.error(effect, q, pace)
        poses = [self.moved(k, angle) for k, angle in enumerate(angles)]
        unloaded = list(angles)
        for _ in range(3 if self.springs else 0):  # what gives moves its own load
            torques = self.torques(poses)
            for k, compliance in self.springs:
                angles[k] = unloaded[k] + compliance * torques[k]
                poses[k] = self.moved(k, angles[k])
        torques = self.torques(poses) if self.loose else {}
        for effect in self.loose:  # the state: the side on which the joint rests
            k, (width, hold) = effect["joint"], effect["values"]
            if not effect["state"] or abs(torques[k]) > hold:
                effect["state"][:] = [-1.0 if torques[k] < 0.0 else 1.0]
            angles[k] += 0.5 * width * effect["state"][0]
            poses[k] = self.moved(k, angles[k])
        a, b, c, x, d, e, f, y, g, h, i, z = self.reached(self.camera, poses, IDENTITY)
        back = (a, d, g, -a * x - d * y - g * z, b, e, h, -b * x - e * y - h * z, c, f, i, -c * x - f * y - i * z)
        return angles, self.reached(self.marker, poses, back)

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

    def moved(self, k, angle):
        """Return the pose of a joint's frame in its parent's."""
        slides, (a, b, c, x, d, e, f, y, g, h, i, z) = self.joints[k]
        if slides:
            return a, b, c, x + angle * c, d, e, f, y + angle * f, g, h, i, z + angle * i
        u, v = math.cos(angle), math.sin(angle)
        return (
            u * a + v * b,
            u * b - v * a,
            c,
            x,
            u * d + v * e,
            u * e - v * d,
            f,
            y,
            u * g + v * h,
            u * h - v * g,
            i,
            z,
        )

    def reached(self, end, poses, pose):
        """Return the pose of the camera or the marker where that of the root link is `pose`."""
        for k in end[0]:
            pose = product(pose, poses[k])
        return product(pose, end[1])

    def torques(self, poses):
        """Return gravity's torque about each joint that gives or is loose, or force along it."""
        gravity, moments, torques = {-1: self.gravity}, list(self.moments), {}
        for k, parent in self.inside:
            (a, b, c, _, d, e, f, _, g, h, i, _), (x, y, z) = poses[k], gravity[parent]
            gravity[k] = a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z
        for k in self.outside:
            (u, v, w), mass, parent = moments[k], self.masses[k], self.parents[k]
            if k in gravity:
                x, y, z = gravity[k]
                torques[k] = mass * z if self.joints[k][0] else u * y - v * x
            if parent >= 0:
                (a, b, c, x, d, e, f, y, g, h, i, z), (p, q, r) = poses[k], moments[parent]
                p, q, r = p + a * u + b * v + c * w, q + d * u + e * v + f * w, r + g * u + h * v + i * w
                moments[parent] = p + mass * x, q + mass * y, r + mass * z
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
