"""Small rigid transforms."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.records import FloatArray


def transform(rotation: Rotation, translation: FloatArray) -> FloatArray:
    """The homogeneous transform (4, 4) of a rotation and a translation (3,) [m]."""
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = translation
    return T


def joint_motion(axis: FloatArray, prismatic: bool, value: float) -> FloatArray:
    """What a joint does at `value` [rad or m]: a turn about its axis or a slide along it, shape (4, 4)."""
    if prismatic:
        return transform(Rotation.identity(), axis * value)
    return transform(Rotation.from_rotvec(axis * value), np.zeros(3))


def cross_matrix(vector: FloatArray) -> FloatArray:
    """The matrix (3, 3) of the cross product with `vector` (3,) from the left."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turn_between(R_from: FloatArray, R_to: FloatArray) -> FloatArray:
    """Axis of the turn from one orientation (3, 3) to another, times the sine of its angle, shape (3,)."""
    R = R_to @ R_from.T
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
