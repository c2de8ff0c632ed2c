"""Convert poses given as a shift and a rotation vector."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps.rotations import exponentials


def transforms(values: FloatArray) -> FloatArray:
    """Return transforms (n, 4, 4) of shifts [m] and rotation vectors [rad] (n, 6)."""
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3, :3] = exponentials(values[:, 3:6])[0]
    T[:, :3, 3] = values[:, :3]
    return T


def rotation(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotation (3, 3) of a pose's values (6, ...), and the rotation per change of its numbers (3, 3)."""
    turns, jacobians = exponentials(values[None, 3:6])
    return turns[0], jacobians[0]
