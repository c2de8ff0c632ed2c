"""Simulate joint encoders: convert true angles to readings quantised to ticks."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .config import EncoderConfig


class Encoders:
    """Encoder model that adds offset and noise to angles and rounds them to whole ticks.

    Args:
        offsets: reported minus true angle [rad or m], shape (d,).
        prismatic: which joints slide, shape (d,).
    """

    def __init__(
        self, config: EncoderConfig, offsets: FloatArray, prismatic: np.ndarray, rng: np.random.Generator
    ) -> None:
        self._tick = np.where(prismatic, 1.0 / config.ticks_per_metre, 2 * np.pi / config.ticks_per_turn)
        self._noise = config.noise_ticks
        self._offsets = offsets
        self._rng = rng

    def read(self, true: FloatArray) -> FloatArray:
        """Return the readings (d,) [rad or m] at the true angles, or drive positions, `true` (d,)."""
        exact = (true + self._offsets) / self._tick
        noisy = exact + self._noise * self._rng.standard_normal(exact.shape)
        return np.round(noisy) * self._tick
