"""Express a learnt chain in terms of the robot's files: joint origins, camera pose, marker position.

A chain is a product of transforms, and a camera sees only the product. Its split into parts is a convention:

- the camera's pose and the joint offsets are those of the learner;
- each link moves with the axis of its own joint only, while all joints are at zero; so a mesh stays on the part that it
  shows;
- fixed joints, held joints, and everything off the path from camera to marker keep their origins.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import accumulate
from typing import Self

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps import RigidChain

from .description import RobotDescription
from .urdf import UrdfJoint, fixed_transform, inverse, joint_motion


@dataclass(frozen=True, eq=False)
class CalibratedGeometry:
    """Learnt values of the poses in the robot's files."""

    # poses (4, 4) of the learnt joints' frames in their parent links, by joint; the axes in these frames are unchanged
    T_parent_joint: dict[str, FloatArray]
    T_parent_camera: FloatArray  # pose (4, 4) of the measurement frame in the camera's parent link
    marker_xyz: FloatArray  # the marker (3,) in its link [m]

    @classmethod
    def of(
        cls, robot: RobotDescription, chain: RigidChain, *, T_measured_nominal: FloatArray, zeros: FloatArray
    ) -> Self:
        """Return the geometry of `chain`, split by the convention of this module.

        Args:
            T_measured_nominal: camera displacement (4, 4), as in `kbmaps.ChainReport`.
            zeros: joint offsets (d,) [rad, m], as in `kbmaps.ChainReport`.
        """
        path = _KinematicPath.of(robot)
        joints = zip(chain.axes, chain.prismatic, zeros, strict=True)
        at_zero = [joint_motion(axis, bool(prismatic), value) for axis, prismatic, value in joints]
        # Frames of the joints and the marker, with all joints at zero, in the nominal measurement frame.
        moved = [inverse(zero) @ fixed for zero, fixed in zip(at_zero, chain.fixed[1:], strict=True)]
        frames = _frames([inverse(T_measured_nominal) @ chain.fixed[0], *moved])
        nominal_frames = _frames(robot.chain.fixed)
        T_camera_parent = T_measured_nominal @ inverse(robot.camera.pose)
        if path.upward[0]:
            T_camera_parent = chain.fixed[0] @ inverse(path.between[0])
        # The pose reached on the path, with all joints at zero and before the camera has moved. On an upward path, the
        # link above a joint is that of the next joint if its path leads up too; the topmost keeps its nominal pose.
        reached = inverse(T_measured_nominal) @ T_camera_parent @ path.between[0]
        origins: dict[str, FloatArray] = {}
        for k, joint in enumerate(path.joints):
            if not path.upward[k]:
                origins[joint.name] = inverse(reached) @ frames[k] @ at_zero[k]
                reached = frames[k] @ path.between[k + 1]
                continue
            if k + 1 < len(path.joints) and path.upward[k + 1]:
                T_zero_parent = frames[k + 1] @ inverse(path.between[k + 1])
            else:
                T_zero_parent = nominal_frames[k] @ inverse(joint.T_parent_joint)
            origins[joint.name] = inverse(T_zero_parent) @ frames[k] @ inverse(at_zero[k])
            reached = T_zero_parent @ path.between[k + 1]
        marker = inverse(reached) @ frames[-1]
        return cls(origins, inverse(T_camera_parent), marker[:3, 3])


@dataclass(frozen=True)
class _KinematicPath:
    """Path from the camera's link to the marker's: learnt joints (d), and fixed transforms between them (d+1)."""

    joints: list[UrdfJoint]
    upward: list[bool]
    between: list[FloatArray]

    @classmethod
    def of(cls, robot: RobotDescription) -> Self:
        path = cls([], [], [np.eye(4)])
        for joint, upward in robot.tree.path(robot.camera.parent_link, robot.robot.marker_link):
            if joint.name in robot.joints:
                path.joints.append(joint)
                path.upward.append(upward)
                path.between.append(np.eye(4))
            else:
                held = robot.robot.held_at.get(joint.name, 0.0)
                path.between[-1] = path.between[-1] @ fixed_transform(joint, upward, held)
        return path


def _frames(transforms: Iterable[FloatArray]) -> list[FloatArray]:
    return list(accumulate(transforms, operator.matmul))
