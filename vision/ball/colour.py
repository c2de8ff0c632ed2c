"""Colour gates: a mask of the marker's colour, and the amount of that colour in each pixel."""

from __future__ import annotations

from typing import Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import ImageArray
from bodyschema.vision.config import HueBand, VisionConfig

from .settings import ColourSettings as _Settings

Float32Array = NDArray[np.float32]


class Gate(Protocol):
    """Classifier of the marker's pixels."""

    @property
    def shading_sigma(self) -> float:
        """Relative difference (1-sigma) of the marker's brightness between its limb and slightly further inside."""
        ...

    def mask(self, image: ImageArray) -> ImageArray:
        """Return 255 where a BGR image (height, width, 3) may show the marker, else 0; shape (height, width)."""
        ...

    def amount(self, image: ImageArray | Float32Array) -> Float32Array:
        """Return the amount of the marker's light in each pixel of a BGR image (..., 3), shape (...), in grey
        levels.
        """
        ...

    def adapt(self, pixels: ImageArray) -> None:
        """Learn from BGR pixels (height, width, 3) of the middle of an accepted ball."""

    def reset(self) -> None:
        """Forget the learned colour."""


class ColourGate:
    """Gate for pixels of one band of hues.

    The band follows the ball's colour through changing light: slowly, only by pixels of accepted fixes, and at most
    `_Settings.farthest` from its initial position, so that it cannot drift to another object.
    """

    shading_sigma = 0.3

    def __init__(self, band: HueBand) -> None:
        self._first = self._band = band
        self._use(band)

    def adapt(self, pixels: ImageArray) -> None:
        """Learn from BGR pixels (height, width, 3) of the middle of an accepted ball."""
        hsv = cv2.cvtColor(pixels, cv2.COLOR_BGR2HSV).reshape(-1, 3).astype(np.float64)
        off_deg = (2.0 * hsv[:, 0] - self._band.hue_deg + 180.0) % 360.0 - 180.0
        first, rate = self._first, _Settings.adapted
        drift_deg = (self._band.hue_deg - first.hue_deg + 180.0) % 360.0 - 180.0 + rate * float(np.median(off_deg))
        max_deg = _Settings.farthest * first.half_width_deg
        low = len(hsv) // 10
        saturation, value = (float(np.partition(hsv[:, channel], low)[low]) / 255.0 for channel in (1, 2))
        self._use(
            HueBand(
                (first.hue_deg + min(max(drift_deg, -max_deg), max_deg)) % 360.0,
                first.half_width_deg,
                _adapted_limit(self._band.min_saturation, _Settings.room * saturation, first.min_saturation),
                _adapted_limit(self._band.min_value, _Settings.room * value, first.min_value),
            )
        )

    def reset(self) -> None:
        """Restore the band of the configuration."""
        self._use(self._first)

    def _use(self, band: HueBand) -> None:
        self._band = band
        self._ranges = _hsv_ranges(band)
        self._weights_bgr = _chroma_weights(band.hue_deg)

    def mask(self, image: ImageArray) -> ImageArray:
        """Return 255 where a BGR image (height, width, 3) has the colour, else 0; shape (height, width)."""
        hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
        mask = cv2.inRange(hsv, *self._ranges[0])
        for lower, upper in self._ranges[1:]:
            cv2.bitwise_or(mask, cv2.inRange(hsv, lower, upper), mask)
        return cast(ImageArray, mask)

    def amount(self, image: ImageArray | Float32Array) -> Float32Array:
        """Return the amount of the colour in each pixel of a BGR image (..., 3), shape (...), in grey levels.

        A linear function of the channels that is 0 for all greys: white highlights and grey backgrounds add
        nothing, and a pixel that the marker covers by half has half of it.
        """
        return image.astype(np.float32, copy=False) @ self._weights_bgr


class BrightGate:
    """Gate for a marker brighter than its surroundings, of any colour: a lamp, a white or retro-reflective ball."""

    # Its brightness is all that tells it.
    shading_sigma = 0.1

    def __init__(self, min_brightness: float) -> None:
        """Accept pixels from `min_brightness` on, where 1 is white."""
        self._first = self._lowest = 255.0 * min_brightness

    def mask(self, image: ImageArray) -> ImageArray:
        """Return 255 where a BGR image (height, width, 3) is bright, else 0; shape (height, width)."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return cast(ImageArray, cv2.threshold(grey, self._lowest, 255, cv2.THRESH_BINARY)[1])

    def adapt(self, pixels: ImageArray) -> None:
        """Set the limit to half of the ball's brightness, clipped to between half and all of the configured limit."""
        seen = float(np.median(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)))
        self._lowest = _adapted_limit(self._lowest, _Settings.room * seen, self._first)

    def reset(self) -> None:
        """Restore the configured brightness."""
        self._lowest = self._first

    def amount(self, image: ImageArray | Float32Array) -> Float32Array:
        """Return the brightness of each pixel of a BGR image (..., 3), shape (...), in grey levels."""
        return image.astype(np.float32, copy=False) @ np.full(3, 1 / 3, np.float32)


def gate_of(config: VisionConfig) -> Gate:
    """Create the gate for the ball that `config` describes."""
    return BrightGate(config.min_brightness) if config.marker == "bright_ball" else ColourGate(config.band)


def _adapted_limit(limit: float, target: float, first: float) -> float:
    """Move `limit` one step towards `target`, clipped to between half of `first` and `first`."""
    return min(max(limit + _Settings.adapted * (target - limit), 0.5 * first), first)


def _hsv_ranges(band: HueBand) -> list[tuple[ImageArray, ImageArray]]:
    """Return inclusive (lower, upper) bounds of OpenCV's HSV with hue 0..179; two pairs if the band wraps around
    red.
    """
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
