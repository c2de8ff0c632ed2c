"""Model encoder errors, the first stage; each effect gives the joint's true angle minus the reading."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .effect_type import Effect, EffectType, SimulationRun
from .motion import Motion
from .parameter import Place


class EncoderSettings:
    # Number of runs whose strains are kept: the diagnosis asks again for those of its candidates.
    strains_kept = 256
    forgotten = 1e-17  # share of a past move below which it is ignored


class LiveError(Protocol):
    """An encoder error computed reading by reading."""

    def at(self, motion: Motion, move: float) -> float:
        """Return true angle minus reading [rad, m] at a motion of one row, after a move since the previous row."""
        ...


class EncoderEffect(EffectType):
    """An error of one joint's reading."""

    stage = "encoder"
    at_joint = True
    moves_joints = True

    @abstractmethod
    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        """Return derivatives (n, p) of the true angle by `values` (p,); zeros for those that are not amounts."""

    def correction(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        """Return true angle minus reading (n,) [rad, m]."""
        return self.columns(motion, place, values) @ values

    def live(self, place: Place, values: FloatArray, row_readings: int) -> LiveError:
        """Return the error reading by reading; an effect with memory keeps its state there.

        Args:
            row_readings: number of readings between rows.
        """
        return _MemorylessError(self, place, values)

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        """Return derivatives (n, 3, p) of the measurements by the effect's values."""
        place = run.simulation.place(effect)
        return run.by_joint[:, :, place.joint, None] * self.columns(run.readings, place, effect.values)[:, None, :]


@dataclass(frozen=True)
class _MemorylessError:
    """The error of an effect that depends only on the present reading."""

    effect: EncoderEffect
    place: Place
    values: FloatArray

    def at(self, motion: Motion, move: float) -> float:
        return float(self.effect.correction(motion, self.place, self.values)[0])


class PathElement(Protocol):
    """An element driven reading by reading."""

    def begin(self, reading: float, leading: float) -> None:
        """Start at `reading`, reached in the direction of `leading`; 0 for no direction."""

    def follow(self, reading: float) -> float:
        """Return its output at the next reading."""
        ...


class LivePathElement:
    """`scale` times the output of a driven element; the first move determines its initial state."""

    def __init__(self, place: Place, element: PathElement, scale: float) -> None:
        self._joint, self._element, self._scale = place.joint, element, scale
        self._first: float | None = None
        self._moved = False

    def at(self, motion: Motion, move: float) -> float:
        reading = float(motion.q[0, self._joint])
        if self._first is None:
            self._first = reading
        if not self._moved and reading != self._first:
            self._moved = True
            self._element.begin(self._first, reading - self._first)
        return self._scale * self._element.follow(reading)


def decaying_sum(added: FloatArray, kept: FloatArray) -> FloatArray:
    """Solve e_i = added_i + kept_i e_{i-1} for all rows (n,); the first row keeps nothing."""
    total, kept, back = added.copy(), kept.copy(), 1
    # Doubling: `kept` is the share of a row that remains after `back` rows.
    while back < len(total) and np.abs(kept).max() > EncoderSettings.forgotten:
        total[back:] += kept[back:] * total[:-back]
        kept[back:] *= kept[:-back]
        back *= 2
    return total
