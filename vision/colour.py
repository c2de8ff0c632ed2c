"""What has the marker's colour: a mask by hue, and the amount of that colour in each pixel."""

from __future__ import annotations

from typing import Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from interfaces.records import ImageArray

from .config import HueBand, VisionConfig

Float32Array = NDArray[np.float32]


class Gate(Protocol):
    """What tells the marker's pixels from all others."""

    def mask(self, image: ImageArray) -> ImageArray:
        """255 where a BGR image (height, width, 3) may show the marker, else 0; shape (height, width)."""
        ...

    def amount(self, image: ImageArray | Float32Array) -> Float32Array:
        """How much of the marker's light each pixel of a BGR image (..., 3) has, shape (...), in grey levels."""
        ...


class ColourGate:
    """Tells pixels of one band of hues from all others."""

    def __init__(self, band: HueBand) -> None:
        self._ranges = _hsv_ranges(band)
        self._weights_bgr = _chroma_weights(band.hue_deg)

    def mask(self, image: ImageArray) -> ImageArray:
        """255 where a BGR image (height, width, 3) has the colour, else 0; shape (height, width)."""
        hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
        mask = cv2.inRange(hsv, *self._ranges[0])
        for lower, upper in self._ranges[1:]:
            cv2.bitwise_or(mask, cv2.inRange(hsv, lower, upper), mask)
        return cast(ImageArray, mask)

    def amount(self, image: ImageArray | Float32Array) -> Float32Array:
        """How much of the colour each pixel of a BGR image (..., 3) has, shape (...), in grey levels.

        A linear function of the channels that is 0 for all greys: white highlights and grey backgrounds add
        nothing, and a pixel that the marker covers by half has half of it.
        """
        return image.astype(np.float32, copy=False) @ self._weights_bgr


class BrightGate:
    """Tells what is brighter than all around it, of whatever colour: a lamp, a white ball, a retro-reflective one."""

    def __init__(self, min_brightness: float) -> None:
        """Pixels from `min_brightness` on count, where 1 is white."""
        self._lowest = 255.0 * min_brightness

    def mask(self, image: ImageArray) -> ImageArray:
        """255 where a BGR image (height, width, 3) is bright, else 0; shape (height, width)."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return cast(ImageArray, cv2.threshold(grey, self._lowest, 255, cv2.THRESH_BINARY)[1])

    def amount(self, image: ImageArray | Float32Array) -> Float32Array:
        """The brightness of each pixel of a BGR image (..., 3), shape (...), in grey levels."""
        return image.astype(np.float32, copy=False) @ np.full(3, 1 / 3, np.float32)


def gate_of(config: VisionConfig) -> Gate:
    """What tells the ball that `config` describes."""
    return BrightGate(config.min_brightness) if config.marker == "bright_ball" else ColourGate(config.band)


def _hsv_ranges(band: HueBand) -> list[tuple[ImageArray, ImageArray]]:
    """Inclusive (lower, upper) bounds of OpenCV's HSV with hue 0..179; two of them where the band goes over red."""
    low = round((band.hue_deg - band.half_width_deg) / 2)
    high = round((band.hue_deg + band.half_width_deg) / 2)
    if low < 0:
        spans = [(0, high), (low + 180, 179)]
    elif high > 179:
        spans = [(low, 179), (0, high - 180)]
    else:
        spans = [(low, high)]
    saturation, value = round(255 * band.min_saturation), round(255 * band.min_value)
    return [
        (np.array([first, saturation, value], np.uint8), np.array([last, 255, 255], np.uint8)) for first, last in spans
    ]


def _chroma_weights(hue_deg: float) -> Float32Array:
    """Weights of (B, G, R): the projection onto the direction `hue_deg` in the plane of constant R + G + B."""
    hue = np.deg2rad(hue_deg)
    red_angle_of_channel = np.deg2rad([240.0, 120.0, 0.0])
    return np.cos(red_angle_of_channel - hue).astype(np.float32)
