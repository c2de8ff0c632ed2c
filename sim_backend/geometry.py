"""Small rigid transforms."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.records import FloatArray


def transform(rotation: Rotation, translation: FloatArray) -> FloatArray:
    """Return the homogeneous transform (4, 4) of a rotation and a translation (3,) [m]."""
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = translation
    return T


def joint_motion(axis: FloatArray, prismatic: bool, value: float) -> FloatArray:
    """Return the transform (4, 4) of a joint at `value`: a rotation about its axis [rad] or a slide along it [m]."""
    if prismatic:
        return transform(Rotation.identity(), axis * value)
    return transform(Rotation.from_rotvec(axis * value), np.zeros(3))


def cross_matrix(vector: FloatArray) -> FloatArray:
    """Return the skew-symmetric matrix (3, 3) of `vector` (3,): its product with x is the cross product vector × x."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turn_between(R_from: FloatArray, R_to: FloatArray) -> FloatArray:
    """Return the rotation axis (3,) from one orientation (3, 3) to another, times the sine of the angle."""
    R = R_to @ R_from.T
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
