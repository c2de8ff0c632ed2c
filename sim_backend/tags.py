"""Printed tags in the hand, ray-cast: exact planes with exact squares on them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.records import FloatArray

from .config import SimTag

_BLACK, _WHITE = 0.06, 0.86
_AMBIENT, _DIFFUSE = 0.6, 0.4
# Squares across a tag: black border, data, black border.
_SQUARES = 8


class TagSheets:
    """Tags on a rigid body, each on a sheet of its own that is seen from its front alone."""

    def __init__(self, tags: Sequence[SimTag], dictionary: int) -> None:
        patterns = cv2.aruco.getPredefinedDictionary(dictionary)
        self._tags = tuple(tags)
        self._turns = [Rotation.from_euler("xyz", tag.rpy).as_matrix() for tag in tags]
        # One pixel a square, from the top left; True where it is black.
        self._black = [patterns.generateImageMarker(tag.id, _SQUARES, borderBits=1) < 128 for tag in tags]

    def cast(
        self, directions: FloatArray, x: FloatArray, R: FloatArray, depth: FloatArray, to_light: FloatArray
    ) -> tuple[np.ndarray, FloatArray]:
        """Return the mask of the rays that hit a sheet before anything else, and its colour there.

        Args:
            directions: rays (n, m, 3) in the eye's optical frame with z = 1.
            x, R: the marker's pose in that frame, (3,) [m] and (3, 3).
            depth: distance along z of everything else (n, m) [m].
            to_light: unit vector to the light (3,) in that frame.

        Returns:
            The mask (n, m) and the colours (k, 3), 0 to 255, of the rays in the mask.
        """
        nearest, level = depth.copy(), np.full(depth.shape, np.nan)
        for tag, turn, black in zip(self._tags, self._turns, self._black, strict=True):
            axes, centre = R @ turn, x + R @ np.array(tag.xyz)
            facing = directions @ axes[:, 2]
            seen = facing < 0.0
            z = np.divide(centre @ axes[:, 2], facing, out=np.full(depth.shape, np.inf), where=seen)
            seen &= (z > 0.0) & (z < nearest)
            place = (directions[seen] * z[seen][:, None] - centre) @ axes[:, :2]
            on_sheet = np.abs(place).max(axis=1) < tag.half_sheet_m
            seen[seen] = on_sheet
            lit = _AMBIENT + _DIFFUSE * max(float(axes[:, 2] @ to_light), 0.0)
            level[seen] = lit * np.where(_is_black(place[on_sheet] / tag.side_m, black), _BLACK, _WHITE)
            nearest[seen] = z[seen]
        mask = np.isfinite(level)
        return mask, np.repeat(255.0 * level[mask][:, None], 3, axis=1)


def _is_black(place: FloatArray, black: np.ndarray) -> np.ndarray:
    """Return a mask (k,) of the points (k, 2) that are black on a tag of side 1, x right and y up from its middle."""
    column = np.floor((place[:, 0] + 0.5) * _SQUARES).astype(np.intp)
    row = np.floor((0.5 - place[:, 1]) * _SQUARES).astype(np.intp)
    inside = (column >= 0) & (column < _SQUARES) & (row >= 0) & (row < _SQUARES)
    return inside & black[row.clip(0, _SQUARES - 1), column.clip(0, _SQUARES - 1)]
