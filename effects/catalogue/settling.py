"""A joint that is read before it has come to rest."""

from __future__ import annotations

from collections import deque
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects.effect_type import Effect, SimulationRun
from bodyschema.effects.encoder import EncoderEffect, EncoderSettings, decaying_sum
from bodyschema.effects.joint_errors import Rows
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter, Place
from bodyschema.interfaces.records import FloatArray, frozen_array


class _Settings:
    # Shares of a lag that remain at the next reading: those tried, the largest step, and the largest.
    memories, of_a_memory, longest_memory = np.linspace(0.0, 0.9, 19), 0.1, 0.95
    at_rest = 0.05  # the joint is at rest when this share of its initial lag remains


class Settling(EncoderEffect):
    """Lag of a joint read before it has settled: a fraction of the last move, plus the decayed earlier lag.

    true angle = reading - e, with e_i = fraction · move_i + memory^(dt_i / usual dt) · e_{i-1}.
    """

    name = "settling"
    rank = 7
    remembers = True
    search = "shape"
    no_counterpart = "it depends on the moves between readings"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        memory = Parameter("memory", 0.0, None, smooth=True, below_one=True)
        return (Parameter("fraction", 0.05, never_negative=True), memory)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        shortfall = _cached_shortfall(motion, place.joint, float(values[1]))
        return np.stack([-shortfall, np.zeros_like(shortfall)], axis=1)

    def live(self, place: Place, values: FloatArray, row_readings: int) -> _LiveSettling:
        return _LiveSettling(values, row_readings)

    def trial_shapes(self, motion: Motion) -> FloatArray:
        return _Settings.memories

    def shape_step(self, run: SimulationRun, effect: Effect, k: int) -> float:
        return _Settings.of_a_memory

    def bounded(self, effect: Effect, k: int, value: float, motion: Motion) -> float:
        return float(np.clip(value, 0.0, _Settings.longest_memory))

    def unknown_state(self, run: SimulationRun, effect: Effect) -> NDArray[np.bool_]:
        """Return rows (n,), except the first of a run, at which the joint has not settled from before the run."""
        motion, memory = run.motion, effect.value("memory")
        rows = np.zeros(len(motion), dtype=np.bool_)
        if memory > 0.0:
            for first, end in motion.runs:
                rows[first + 1 : end] = memory ** np.cumsum(motion.pace[first + 1 : end]) > _Settings.at_rest
        return rows

    def correction_rows(self, effect: Effect, place: Place) -> Rows:
        return {"memories": [[place.joint, 2, *effect.values.tolist()]]}


@lru_cache(maxsize=EncoderSettings.strains_kept)
def _cached_shortfall(motion: Motion, joint: int, memory: float) -> FloatArray:
    """Return the lag after the last and earlier moves (n,); cached, since a search repeats the same values."""
    moves = motion.moves[:, joint]
    if memory == 0.0:
        return moves
    kept = np.sign(memory) * abs(memory) ** motion.pace
    kept[motion.begins] = 0.0
    return frozen_array(decaying_sum(moves, kept))


class _LiveSettling:
    """Remaining lag of a joint that is read before it has settled."""

    def __init__(self, values: FloatArray, row_readings: int) -> None:
        self._fraction, self._memory = values.tolist()
        self._cached_shortfall: deque[float] = deque([0.0] * row_readings, maxlen=row_readings)

    def at(self, motion: Motion, move: float) -> float:
        """Return minus the remaining lag [rad, m] after the move since the previous row."""
        self._cached_shortfall.append(self._fraction * move + self._memory * self._cached_shortfall[0])
        return -self._cached_shortfall[-1]
