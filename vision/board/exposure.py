"""Checks of brightness and focus for an image in which no board was found."""

from __future__ import annotations

from typing import Literal

import numpy as np

from bodyschema.interfaces.records import ImageArray
from bodyschema.vision.images import is_black, too_white

from .sharpness import sharpest_edge_px

# Corner accuracy is a small share of the edge width; with more blur that share is too large.
MOST_BLUR_PX = 2.5


def image_fault(grey: ImageArray) -> tuple[Literal["dark", "over_exposed", "blurred"], str] | None:
    """Return kind and message of what is wrong with the whole image (height, width); None if nothing is."""
    if is_black(grey):
        return "dark", "the image is black. Take the lens cap off; longer exposure, more light"
    if (white := too_white(grey)) is not None:
        return "over_exposed", f"over-exposed: {white:.0%} of the image is white. Shorten the exposure, less light"
    edge = sharpest_edge_px(np.asarray(grey, dtype=np.float64))
    if edge > MOST_BLUR_PX:
        return "blurred", f"blurred: the sharpest edge has a 1-sigma of {edge:.1f} px. Focus; hold the board still"
    return None
