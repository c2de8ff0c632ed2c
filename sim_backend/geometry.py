"""Small rigid transforms."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps.rotations import exponentials


def transform(turn: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the homogeneous transform (4, 4) of a rotation vector (3,) [rad] and a translation (3,) [m]."""
    T = np.eye(4)
    T[:3, :3] = rotation(turn)
    T[:3, 3] = translation
    return T


def rotation(turn: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) [rad]."""
    return exponentials(turn[None])[0][0]


def turn_of_z(direction: FloatArray) -> FloatArray:
    """Return a rotation matrix (3, 3) that rotates the z axis to a unit vector (3,)."""
    across = np.eye(3)[np.abs(direction).argmin()]
    x = np.cross(across, direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(direction, x), direction], axis=1)


def turn_between(R_from: FloatArray, R_to: FloatArray) -> FloatArray:
    """Return the rotation axis (3,) from one orientation (3, 3) to another, times the sine of the angle."""
    R = R_to @ R_from.T
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
