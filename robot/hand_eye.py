"""The camera's pose for ROS: in SI units, as quaternion and matrix, with a covariance, as a static transform."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Self

import msgspec

# numpy is imported where it is used: clients that only read these messages do without.
if TYPE_CHECKING:
    from bodyschema.interfaces.records import FloatArray

LAUNCH = "hand_eye.launch.py"
# Of the numerical derivative of a pose [m, rad]: truncation and rounding are of the same size.
_STEP = math.sqrt(sys.float_info.epsilon)
_PUBLISHER = "static_transform_publisher"


class HandEye(msgspec.Struct, frozen=True):
    """A pose of one frame in another, in SI."""

    # parent, child: the frames; the pose is that of `child` in `parent`
    parent: str
    child: str
    translation_m: list[float]  # x, y, z
    quaternion_xyzw: list[float]  # unit quaternion, w not negative
    matrix: list[list[float]]  # homogeneous, four rows of four
    # 6 x 6, row by row as in geometry_msgs/PoseWithCovariance: x, y, z [m²], then turns about the parent's x, y, z
    # [rad²]; null where it is not known
    covariance: list[float] | None
    static_transform_publisher: str  # the command that publishes it in ROS 2

    @classmethod
    def of(cls, parent: str, child: str, T_parent_child: FloatArray, covariance: FloatArray | None = None) -> Self:
        """Return a pose (4, 4) with its covariance (6, 6) in ROS's order."""
        from kbmaps.rotations import quaternions

        quaternion, place = quaternions(T_parent_child[None, :3, :3])[0].tolist(), T_parent_child[:3, 3].tolist()
        return cls(
            parent,
            child,
            place,
            quaternion,
            T_parent_child.tolist(),
            None if covariance is None else covariance.ravel().tolist(),
            " ".join(["ros2 run tf2_ros", _PUBLISHER, *_arguments(place, quaternion, parent, child)]),
        )


class MarkerPose(msgspec.Struct, frozen=True):
    """A pose of the marker in the measurement frame, in SI: the form of all messages, with the names of `HandEye`."""

    translation_m: list[float]  # x, y, z
    # quaternion_xyzw, matrix: orientation, and homogeneous matrix of four rows of four; null without an orientation
    quaternion_xyzw: list[float] | None
    matrix: list[list[float]] | None
    # 6 x 6, row by row, as that of `HandEye`, of a prediction without correlations; null where that of the orientation
    # is not known
    covariance: list[float] | None
    translation_covariance: list[float]  # 3 x 3, row by row [m²]

    @classmethod
    def of(cls, x: FloatArray, cov: FloatArray, R: FloatArray | None = None, cov_R: FloatArray | None = None) -> Self:
        """Return one pose, as `rows` does."""
        return cls.rows(x[None], cov[None], None if R is None else R[None], None if cov_R is None else cov_R[None])[0]

    @classmethod
    def rows(
        cls, x: FloatArray, cov: FloatArray, R: FloatArray | None = None, cov_R: FloatArray | None = None
    ) -> list[Self]:
        """Return n poses.

        Args:
            x: positions (n, 3) [m].
            cov: their covariances (n, 3, 3), or their 1-sigma (n, 3).
            R: orientations, unit quaternions (n, 4).
            cov_R: covariances (n, 3, 3) of a small rotation about the axes [rad²], or its 1-sigma (n, 3).
        """
        import numpy as np

        from kbmaps.rotations import cross_matrix

        n = len(x)
        six = np.zeros((n, 6, 6))
        six[:, :3, :3], nothing = _covariances(cov), [None] * n
        places, narrow = x.tolist(), six[:, :3, :3].reshape(n, 9).tolist()
        if R is None:
            return [cls(place, None, None, None, each) for place, each in zip(places, narrow, strict=True)]
        unit: FloatArray = R / np.linalg.norm(R, axis=1)[:, None]  # some are written with few digits
        T = np.tile(np.eye(4), (n, 1, 1))
        K = cross_matrix(unit[:, :3])
        T[:, :3, :3] += 2.0 * (unit[:, 3:, None] * K + K @ K)
        T[:, :3, 3] = x
        if cov_R is not None:
            six[:, 3:, 3:] = _covariances(cov_R)
        wide = nothing if cov_R is None else six.reshape(n, 36).tolist()
        return [cls(*row) for row in zip(places, unit.tolist(), T.tolist(), wide, narrow, strict=True)]


def _covariances(of: FloatArray) -> FloatArray:
    """Return covariances (n, 3, 3), unchanged or from their 1-sigma (n, 3)."""
    import numpy as np

    return of if of.ndim == 3 else np.square(of)[:, :, None] * np.eye(3)


def in_shell_lines(pose: HandEye) -> str:
    """Return the command split into lines that fit a terminal and can be pasted together."""
    command, *options = pose.static_transform_publisher.split(" --")
    rows = [options[:3], options[3:5], options[5:7], *([option] for option in options[7:])]
    return " \\\n".join([command, *("   " + "".join(f" --{option}" for option in row) for row in rows)])


def pose_covariance(pose: Callable[[FloatArray], FloatArray], values: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of a pose's position [m] and rotation about the parent's axes [rad].

    Args:
        pose: returns the pose (4, 4) for values such as `values` (p,).
        covariance: covariance of the values, shape (p, p).
    """
    import numpy as np

    from kbmaps.rotations import rotation_vector

    here, jacobian = pose(values), np.empty((6, len(values)))
    for k in range(len(values)):
        moved = pose(values + _STEP * np.eye(len(values))[k])
        jacobian[:3, k] = (moved[:3, 3] - here[:3, 3]) / _STEP
        jacobian[3:, k] = rotation_vector(moved[:3, :3] @ here[:3, :3].T) / _STEP
    return jacobian @ covariance @ jacobian.T


def write_launch_file(pose: HandEye, folder: Path) -> Path:
    """Write a ROS 2 launch file that publishes the pose on /tf_static; an older one is replaced.

    Raises:
        ConfigError: it cannot be written.
    """
    from bodyschema.interfaces.whole_files import raising_write_errors, write_atomically

    file = folder / LAUNCH
    arguments = _arguments(pose.translation_m, pose.quaternion_xyzw, pose.parent, pose.child)
    text = _LAUNCH_FILE.format(package="tf2_ros", executable=_PUBLISHER, arguments=arguments)
    with raising_write_errors(file, remedy="Give another folder"):
        write_atomically({file: text.encode()})
    return file


_LAUNCH_FILE = '''\
"""Publish the calibrated pose of the camera on /tf_static: `ros2 launch hand_eye.launch.py`."""

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    arguments = {arguments!r}
    return LaunchDescription([Node(package={package!r}, executable={executable!r}, arguments=arguments)])
'''


def _arguments(place: list[float], quaternion: list[float], parent: str, child: str) -> list[str]:
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    numbers = [f"{value + 0.0:.9f}" for value in (*place, *quaternion)]
    words = [word for pair in zip(names, numbers, strict=True) for word in pair]
    return [*words, "--frame-id", parent, "--child-frame-id", child]
