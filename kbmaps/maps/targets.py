"""Conversion of measured positions and orientations to the outputs of a map."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray
from kbmaps.errors import SettingError, ShapeError
from kbmaps.maps.kbmap import POSE_OUTPUTS, POSITION_OUTPUTS
from kbmaps.rotations import rotation_matrices


def pose_targets(positions: FloatArray, rotation: ArrayLike | None, outputs: int) -> FloatArray:
    """Return outputs (n, 3 or 12) of a map for checked positions (n, 3) [m] and, if it has them, orientations.

    Args:
        positions: checked positions (n, 3) [m].
        rotation: (n, 3, 3), or unit quaternions x, y, z, w (n, 4); for one pair also (3, 3) or (4,).
        outputs: of the map.

    Raises:
        ShapeError, NonFiniteError, RotationError
        SettingError: a rotation for a map of positions, or none for a map of poses.
    """
    if rotation is None:
        if outputs == POSE_OUTPUTS:
            raise SettingError("this map has an orientation, so every pair needs a rotation beside its position")
        return positions
    if outputs == POSITION_OUTPUTS:
        raise SettingError("this map has positions alone; to learn orientations begin with a map that has them")
    matrices = rotation_matrices("rotation", rotation).reshape(-1, 3, 3)
    if len(matrices) != len(positions):
        raise ShapeError("rotation", f"({len(positions)}, 3, 3) or ({len(positions)}, 4) to go with x", matrices.shape)
    return np.concatenate([positions, matrices.swapaxes(1, 2).reshape(-1, 9)], axis=1)
