"""Collect the errors of each joint in the terms of a rigid-body simulator."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bodyschema.interfaces.records import FloatArray


@dataclass(frozen=True)
class Wave:
    """A periodic error: amplitude · cos(frequency · reading - phase).

    Attributes:
        name: name of the effect.
        amplitude: [rad, m].
        phase: [rad].
        frequency: radians per unit of the reading.
    """

    name: str
    amplitude: float
    phase: float
    frequency: float


@dataclass
class JointErrors:
    """Errors between a joint's reading and its true angle.

    Attributes:
        offset: added to the reading [rad, m].
        ratios: share of each joint's reading that is added, by the joint; the joint's own is its scale error.
        waves: periodic errors.
        play: width of the backlash [rad, m].
        loose: width [rad, m] of the backlash under gravity, and the friction [N·m, N] that holds it on its side.
        compliance: [rad/(N·m), m/N].
    """

    offset: float = 0.0
    ratios: dict[str, float] = field(default_factory=dict)
    waves: list[Wave] = field(default_factory=list)
    play: float = 0.0
    loose: tuple[float, float] | None = None
    compliance: float = 0.0

    def add_ratio(self, source: str, ratio: float) -> None:
        """Add a share of a joint's reading."""
        self.ratios[source] = self.ratios.get(source, 0.0) + ratio

    def add_wave(self, name: str, values: FloatArray, frequency: float) -> None:
        """Add a periodic error with a sine and a cosine amplitude, the first two of `values`.

        Args:
            frequency: radians per unit of the reading.
        """
        sine, cosine = values[:2].tolist()
        self.waves.append(Wave(name, float(np.hypot(sine, cosine)), float(np.arctan2(sine, cosine)), frequency))
