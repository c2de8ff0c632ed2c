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


def moved_and_turned(shifts: FloatArray, axes: FloatArray, lever: FloatArray) -> FloatArray:
    """Return moves (n, 3, 6) at levers (n, 3): shifts (n, 3, 3), and turns about the columns of axes (n, 3, 3)."""
    turned = np.cross(np.swapaxes(axes, 1, 2), lever[:, None, :])
    return np.concatenate([shifts, np.swapaxes(turned, 1, 2)], axis=2)


def moved_by_observer(values: FloatArray, x: FloatArray) -> FloatArray:
    """Return moves (n, 3, 6) of points x (n, 3) in an observer's frame, by the values (6, ...) of its pose."""
    turn, by_turn = rotation(values)
    axes = np.broadcast_to(-turn.T, (len(x), 3, 3))
    return moved_and_turned(axes, axes @ by_turn, x)
