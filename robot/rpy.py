"""Roll, pitch and yaw as URDF defines them: R = Rz(yaw) · Ry(pitch) · Rx(roll)."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray


def rpy_of(rotation: FloatArray) -> FloatArray:
    """Return the angles (3,) [rad] of a rotation matrix (3, 3), exact to rounding even in gimbal lock."""
    r = rotation
    pitch = np.arctan2(-r[2, 0], np.hypot(r[2, 1], r[2, 2]))
    roll = np.arctan2(r[2, 1], r[2, 2])
    # Near a pitch of ±90° roll is arbitrary. Yaw is computed from the rotation left after this roll, so that the
    # product is right in any case.
    sine, cosine = np.sin(roll), np.cos(roll)
    yaw = np.arctan2(sine * r[0, 2] - cosine * r[0, 1], cosine * r[1, 1] - sine * r[1, 2])
    return np.array([roll, pitch, yaw])


def rotation_of(rpy: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) of roll, pitch and yaw (3,) [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def pose_of(xyz: FloatArray, rpy: FloatArray) -> FloatArray:
    """Return the pose (4, 4) at a position (3,) [m] with these angles (3,) [rad]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_of(rpy), xyz
    return T
