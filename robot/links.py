"""Poses of all links of a robot at its joint readings."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .description import RobotDescription
from .urdf import UrdfJoint, motions


def link_poses(robot: RobotDescription, q: FloatArray) -> dict[str, FloatArray]:
    """Return the poses (n, 4, 4) of all links in the root link's frame at readings q (n, d), parents first.

    Joints that are not among the robot's stand where robot.toml holds them, else at 0.
    """
    columns = dict(zip(robot.joints, q.T, strict=True))
    below: dict[str, list[UrdfJoint]] = {link: [] for link in robot.tree.links}
    for joint in robot.tree.joints.values():
        below[joint.parent].append(joint)
    children = {joint.child for joint in robot.tree.joints.values()}
    poses = {link: np.tile(np.eye(4), (len(q), 1, 1)) for link in below if link not in children}
    for link in (open_ := list(poses)):  # grows during the loop
        for joint in below[link]:
            held = np.full(len(q), robot.robot.held_at.get(joint.name, 0.0))
            poses[joint.child] = poses[link] @ joint.T_parent_joint @ motions(joint, columns.get(joint.name, held))
            open_.append(joint.child)
    return poses
