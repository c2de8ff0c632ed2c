"""Friction behind an elastic drive."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects.effect_type import Effect, SimulationRun
from bodyschema.effects.encoder import EncoderEffect, EncoderSettings, LivePathElement, decaying_sum
from bodyschema.effects.joint_errors import Rows
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter, Place
from bodyschema.interfaces.records import FloatArray, frozen_array

from .backlash import WIDTHS


class _Settings:
    lengths = np.geomspace(5e-4, 0.3, 14)  # lengths tried [rad, m]
    strained_lengths = 3.0  # after this many lengths, only the last direction determines the strain


class Hysteresis(EncoderEffect):
    """Friction behind an elastic drive: the joint lags behind the reading, against the last direction (Dahl 1968).

    true angle = reading - lag · z, where z moves towards the direction of motion over `length`:
    dz = (sign(dq) - z) · |dq| / length.
    """

    name = "hysteresis"
    rank = 8
    remembers = True
    by_direction = True
    search = "shape"
    # A backlash, with one shape parameter more that must pay for itself.
    refines = True
    further_trials = len(WIDTHS)
    no_counterpart = "friction whose lag depends on the way is not in a rigid-body simulator"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        unit, lag, length = ("m", 0.001, 0.005) if prismatic else ("rad", 0.005, 0.03)
        return (
            Parameter(f"lag_{unit}", lag, never_negative=True),
            Parameter(f"length_{unit}", length, None, smooth=True, positive=True),
        )

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        strain = _cached_strain(motion, place.joint, float(values[1]))
        return np.stack([-strain, np.zeros_like(strain)], axis=1)

    def live(self, place: Place, values: FloatArray, row_readings: int) -> LivePathElement:
        lag, length = values.tolist()
        return LivePathElement(place, BristleModel(length), -lag)

    def trial_shapes(self, motion: Motion) -> FloatArray:
        return _Settings.lengths

    def correction_rows(self, effect: Effect, place: Place) -> Rows:
        return {"memories": [[place.joint, 1, *effect.values.tolist()]]}

    def unknown_state(self, run: SimulationRun, effect: Effect) -> NDArray[np.bool_]:
        """Return rows (n,) before the joint has gone far enough one way in a run."""
        travel = _Settings.strained_lengths * float(effect.values[1])
        return run.motion.before_travel(run.simulation.place(effect).joint, travel)


class BristleModel:
    """Friction strain from -1 to 1, driven reading by reading.

    Args:
        length: travel [rad, m] over which it reverses.
    """

    def __init__(self, length: float) -> None:
        self._length = length
        self._last: float | None = None
        self.strain = 0.0

    def begin(self, reading: float, leading: float) -> None:
        """Start at `reading`, reached in the direction of `leading`; 0 for no direction."""
        self._last, self.strain = reading, float(np.sign(leading))

    def follow(self, reading: float) -> float:
        """Return the strain at the next reading."""
        move = 0.0 if self._last is None else reading - self._last
        kept = float(np.exp(-abs(move) / self._length))
        self._last, self.strain = reading, float(np.sign(move)) * (1.0 - kept) + kept * self.strain
        return self.strain


@lru_cache(maxsize=EncoderSettings.strains_kept)
def _cached_strain(motion: Motion, joint: int, length: float) -> FloatArray:
    """Return the strain of a joint's friction (n,), from -1 to 1; it begins in the direction of the first move.

    Between two runs it is driven straight, as a backlash is.
    """
    moves = np.diff(motion.q[:, joint], prepend=motion.q[0, joint])
    leading = moves[np.flatnonzero(moves)[:1]]
    kept = np.exp(-np.abs(moves) / length)
    strain = np.sign(moves) * (1.0 - kept)
    strain[0], kept[0] = float(np.sign(leading[0])) if len(leading) else 0.0, 0.0
    return frozen_array(decaying_sum(strain, kept))
