"""Checks of brightness and focus for an image in which no board was found."""

from __future__ import annotations

from typing import Literal

import numpy as np

from bodyschema.interfaces.records import ImageArray

from .sharpness import sharpest_edge_px

_DARK_LEVEL = 16
_WHITE_LEVEL = 250
_MOST_WHITE = 0.4
_MOST_EDGE_PX = 2.7


def image_fault(grey: ImageArray) -> tuple[Literal["dark", "over_exposed", "blurred"], str] | None:
    """Return kind and message of what is wrong with the whole image (height, width); None if nothing is."""
    if np.quantile(grey, 0.99) < _DARK_LEVEL:
        return "dark", "the image is black. Take the lens cap off; longer exposure, more light"
    white = float(np.mean(grey >= _WHITE_LEVEL))
    if white > _MOST_WHITE:
        return "over_exposed", f"over-exposed: {white:.0%} of the image is white. Shorten the exposure, less light"
    edge = sharpest_edge_px(np.asarray(grey, dtype=np.float64))
    if edge > _MOST_EDGE_PX:
        return "blurred", f"blurred: the sharpest edge has a 1-sigma of {edge:.1f} px. Focus; hold the board still"
    return None
