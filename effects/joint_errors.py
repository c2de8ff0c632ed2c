"""Collect the errors of each joint in the terms of a rigid-body simulator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bodyschema.interfaces.records import FloatArray

# What an effect adds to correction.json: "ratios" (joint, source, factor), "waves" (joint, amplitude, frequency,
# phase), "memories" (joint, kind, amount, scale) and "loose" (joint, half of the width, hold).
Rows = dict[str, list[list[Any]]]


@dataclass(frozen=True)
class Wave:
    """A periodic error: amplitude · cos(frequency · reading - phase)."""

    name: str  # name of the effect
    amplitude: float  # [rad, m]
    phase: float  # [rad]
    frequency: float  # radians per unit of the reading


@dataclass
class JointErrors:
    """Errors between a joint's reading and its true angle."""

    offset: float = 0.0  # added to the reading [rad, m]
    # share of each joint's reading that is added, by the joint; the joint's own is its scale error
    ratios: dict[str, float] = field(default_factory=dict)
    waves: list[Wave] = field(default_factory=list)  # periodic errors
    play: float = 0.0  # width of the backlash [rad, m]
    # width [rad, m] of the backlash under gravity, and the friction [N·m, N] that holds it on its side
    loose: tuple[float, float] | None = None
    compliance: float = 0.0  # [rad/(N·m), m/N]

    def add_ratio(self, source: str, ratio: float) -> None:
        """Add a fraction of a joint's reading."""
        self.ratios[source] = self.ratios.get(source, 0.0) + ratio

    def add_wave(self, name: str, values: FloatArray, frequency: float) -> None:
        """Add a periodic error with a sine and a cosine amplitude, the first two of `values`.

        Args:
            frequency: radians per unit of the reading.
        """
        sine, cosine = values[:2].tolist()
        self.waves.append(Wave(name, float(np.hypot(sine, cosine)), float(np.arctan2(sine, cosine)), frequency))
