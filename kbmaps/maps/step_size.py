"""Step size of an incremental learner: the share of each error that it corrects."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.errors import SettingError

DEFAULT_MU0 = 0.5


@dataclass(frozen=True)
class StepSize:
    """Step size μ(t) = max(floor, mu0 / (1 + t / decay)) after t pairs: constant unless a decay is given.

    Any μ between 0 and 2 is stable. A constant one leaves noise of about 1.6 σ √(μ / (2 − μ)) in the map. One that
    decays averages the noise down to the level of the floor, and the floor keeps the map able to follow changes.

    Attributes:
        mu0: share of the first error that is corrected.
        decay: number of pairs after which it is half of that; infinity for never.
        floor: lower bound of μ.

    Raises:
        SettingError: mu0 is not between 0 and 2, decay not above 0, or floor not within 0..mu0.
    """

    mu0: float = DEFAULT_MU0
    decay: float = math.inf
    floor: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.mu0 < 2.0:
            raise SettingError(f"mu0 must lie between 0 and 2 for the rule to be stable, got {self.mu0!r}")
        if not self.decay > 0.0:
            raise SettingError(f"decay must be greater than 0 pairs (infinity for a constant step), got {self.decay!r}")
        if not 0.0 <= self.floor <= self.mu0:
            raise SettingError(f"floor must lie between 0 and mu0 = {self.mu0!r}, got {self.floor!r}")
        for name in ("mu0", "decay", "floor"):
            object.__setattr__(self, name, float(getattr(self, name)))

    def at(self, pairs: int) -> float:
        """Return μ after this many pairs."""
        return max(self.floor, self.mu0 / (1.0 + pairs / self.decay))

    def run(self, pairs: int, steps: int) -> FloatArray:
        """Return μ (steps,) of the next steps after this many pairs."""
        return np.maximum(self.floor, self.mu0 / (1.0 + np.arange(pairs, pairs + steps) / self.decay))
