"""Blur of edges, as the 1-sigma of the equivalent Gaussian, and the faults of images without a board."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from bodyschema.interfaces.records import FloatArray, ImageArray
from bodyschema.vision.image_checks import is_black, too_white

from .board import Board


class SharpnessSettings:
    along = 0.3  # of a square: where edges are sampled, away from corner and marker
    steepest = 0.999  # quantile of the slopes that counts as the steepest
    max_blur_px = 2.5  # corner accuracy is a small share of the edge width; with more blur that share is too large


def blur_px(grey: ImageArray, board: Board, numbers: NDArray[np.int64], px: FloatArray) -> float:
    """Return the 1-sigma of the blur [px] of the edges between neighbouring corners, in the blurrier direction.

    Args:
        grey: the image, shape (height, width).
        numbers, px: the detected corners, shapes (n,) and (n, 2).
    """
    return max(_edge_blur_px(grey, numbers, px, board, step) for step in (1, board.columns - 1))


def _edge_blur_px(grey: ImageArray, numbers: NDArray[np.int64], px: FloatArray, board: Board, step: int) -> float:
    place = {int(number): k for k, number in enumerate(numbers)}
    width = board.columns - 1
    pairs = [
        (k, place[number + step])
        for number, k in place.items()
        if number + step in place and (step > 1 or (number + 1) % width)
    ]
    if not pairs:
        return 0.0
    first, second = px[[a for a, _ in pairs]], px[[b for _, b in pairs]]
    middle = first + SharpnessSettings.along * (second - first)
    along = second - first
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    levels = _sampled(grey, np.stack([middle - normal, middle + normal]))
    dark, bright = _levels(grey, px)
    steepness = float(np.median(np.abs(levels[1] - levels[0]))) / max(bright - dark, 1.0)
    return _sigma(steepness)


def sharpest_edge_px(grey: FloatArray) -> float:
    """Return the 1-sigma of the blur [px] of the sharpest edges in an image (height, width), with or without a board.

    The direction of the largest blur counts: motion blurs along its own direction only.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    right, down = smooth[1:-1, 2:] - smooth[1:-1, :-2], smooth[2:, 1:-1] - smooth[:-2, 1:-1]
    low, high = np.quantile(smooth, [0.01, 0.99])
    directions = (right, down, (right + down) / np.sqrt(2.0), (right - down) / np.sqrt(2.0))
    steepest = min(float(np.quantile(np.abs(each), SharpnessSettings.steepest)) for each in directions)
    return _sigma(steepest / max(high - low, 1.0))


def _sigma(steepness: float) -> float:
    """Return the sigma of the Gaussian that leaves this share of a step's height between -1 px and +1 px."""
    return float(1.0 / ndtri(0.5 + 0.5 * np.clip(steepness, 1e-3, 0.999)))


def _sampled(grey: ImageArray, at: FloatArray) -> FloatArray:
    maps = at.astype(np.float32)
    levels = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(levels, dtype=np.float64)


def _levels(grey: ImageArray, px: FloatArray) -> tuple[float, float]:
    """Return the black and white levels of the board."""
    low = np.clip(np.floor(px.min(axis=0)).astype(int), 0, None)
    high = np.ceil(px.max(axis=0)).astype(int) + 1
    dark, bright = np.quantile(grey[low[1] : high[1], low[0] : high[0]], [0.1, 0.9])
    return float(dark), float(bright)


def image_fault(grey: ImageArray) -> tuple[Literal["dark", "over_exposed", "blurred"], str] | None:
    """Return kind and message of a fault of the whole image (height, width); None if there is no fault."""
    if is_black(grey):
        return "dark", "the image is black. Take the lens cap off; longer exposure, more light"
    if (white := too_white(grey)) is not None:
        return "over_exposed", f"over-exposed: {white:.0%} of the image is white. Shorten the exposure, less light"
    edge = sharpest_edge_px(np.asarray(grey, dtype=np.float64))
    if edge > SharpnessSettings.max_blur_px:
        return "blurred", f"blurred: the sharpest edge has a 1-sigma of {edge:.1f} px. Focus; hold the board still"
    return None
