"""Backlash between the encoder and its joint, with friction that keeps the joint in place."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects.effect_type import Effect, EffectSettings, SimulationRun
from bodyschema.effects.encoder import EncoderEffect, EncoderSettings, LivePathElement
from bodyschema.effects.joint_errors import JointErrors, Rows
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter, Place
from bodyschema.interfaces.records import FloatArray, frozen_array

WIDTHS = np.geomspace(2e-4, 0.15, 14)  # widths tried [rad, m]


class Backlash(EncoderEffect):
    """Backlash between encoder and joint: the joint rests until the reading has crossed its width."""

    name = "backlash"
    rank = 6
    remembers = True
    by_direction = True
    is_linear = False
    search = "width"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (
            Parameter("width_m", 0.002, never_negative=True)
            if prismatic
            else Parameter("width_rad", 0.01, never_negative=True),
        )

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        wider = self.correction(motion, place, values + EffectSettings.step)
        return ((wider - self.correction(motion, place, values)) / EffectSettings.step)[:, None]

    def correction(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        return _cached_backlash(motion, place.joint, abs(float(values[0]))) * np.sign(values[0])

    def live(self, place: Place, values: FloatArray, row_readings: int) -> LivePathElement:
        width = float(values[0])
        return LivePathElement(place, PlayOperator(abs(width)), float(np.sign(width)))

    def trial_shapes(self, motion: Motion) -> FloatArray:
        return WIDTHS

    def unknown_state(self, run: SimulationRun, effect: Effect) -> NDArray[np.bool_]:
        """Return rows (n,) before the joint first crosses its backlash in a run."""
        return run.motion.before_travel(run.simulation.place(effect).joint, float(effect.values[0]))

    def correction_rows(self, effect: Effect, place: Place) -> Rows:
        half = 0.5 * float(effect.values[0])
        return {"memories": [[place.joint, 0, half, abs(half)]] if half else []}

    def add_to(self, joint: JointErrors, effect: Effect) -> str | None:
        if joint.play or effect.values[0] < 0.0:
            return "a joint has one backlash there"
        joint.play = float(effect.values[0])
        return None


class PlayOperator:
    """A backlash of a width [rad, m], driven reading by reading; its output moves once the input has crossed it."""

    def __init__(self, width: float) -> None:
        self._half = 0.5 * width
        self._output: float | None = None

    def begin(self, reading: float, leading: float) -> None:
        """Start with the input at `reading`, leading by half the width in the direction of `leading`; 0: centred."""
        self._output = reading - self._half * float(np.sign(leading))

    def follow(self, reading: float) -> float:
        """Return output minus input at the next reading."""
        output = reading if self._output is None else self._output
        self._output = min(max(output, reading - self._half), reading + self._half)
        return self._output - reading


def follow_backlash(q: FloatArray, width: float) -> FloatArray:
    """Return output minus input (n,) of a backlash of `width` driven by q (n,), leading in its first direction.

    Between two runs it is driven straight from the last reading of one to the first of the next: the side at the end of
    the run is known, and a long move ends on its own side.
    """
    moves, half = np.diff(q), 0.5 * width
    leading = moves[np.flatnonzero(moves)[:1]]
    begun = q[0] - half * float(np.sign(leading[0])) if len(leading) else q[0]
    # Each reading limits the output to its own range; so do consecutive ones, which are combined by doubling.
    low, high, back = q - half, q + half, 1
    while back < len(q):
        earlier = low[:-back], high[:-back]
        low[back:], high[back:] = (np.minimum(np.maximum(one, low[back:]), high[back:]) for one in earlier)
        back *= 2
    return np.clip(begun, low, high) - q


@lru_cache(maxsize=EncoderSettings.strains_kept)
def _cached_backlash(motion: Motion, joint: int, width: float) -> FloatArray:
    """Return `follow_backlash` of one joint; cached, since a search repeats the same widths."""
    return frozen_array(follow_backlash(motion.q[:, joint], width))
