"""First stage: from a reading to the joint's angle. Each effect here gives the true angle minus the reading."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from bodyschema.interfaces.records import FloatArray, frozen_array

from .motion import Motion
from .parameter import Parameter

# Of the numerical derivative of a play by its width [rad, m].
_WIDTH_STEP = 1e-6
_PLAYS_KEPT, _MEMORIES_KEPT = 256, 256
# What is left of a move when it is forgotten.
_FORGOTTEN = 1e-17
# A magnet farther off its axis, as a share of its radius, is none that could be read.
_FARTHEST_OFF = 0.95


@dataclass(frozen=True, slots=True)
class Place:
    """Where an effect sits: a joint and, for a coupling, the joint that causes it, by their places in q."""

    joint: int
    prismatic: bool
    source: int | None = None


class EncoderEffect(ABC):
    """An error of one joint's reading.

    Attributes:
        name: as in `diagnosis.json`.
        takes_source: whether another joint causes it.
        remembers: whether what it does to a reading depends on the readings before.
        turns_only: whether only a joint that turns can have it.
    """

    name: ClassVar[str]
    takes_source: ClassVar[bool] = False
    remembers: ClassVar[bool] = False
    turns_only: ClassVar[bool] = False

    @abstractmethod
    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        """Its numbers at a joint that turns, or slides."""

    @abstractmethod
    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        """Derivative (n, p) of the true angle by `values` (p,); zeros for those that are no amounts."""

    def correction(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        """True angle minus reading (n,) [rad, m]."""
        return self.columns(motion, place, values) @ values

    def finding(self, at: str, numbers: Mapping[str, float]) -> str:
        """What is wrong, in a clause, where no sentence is known for it. `at` names the joint."""
        amounts = ", ".join(f"{name} = {value:.3g}" for name, value in numbers.items())
        return f"{at} has {self.name.replace('_', ' ')} ({amounts})"

    def remedy(self, at: str) -> str:
        """What to do about it, where nothing is known for it."""
        return f"See what could cause it at {at}; extended.toml takes it into account"


class JointOffset(EncoderEffect):
    """The zero is elsewhere: true angle = reading + offset."""

    name = "joint_offset"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("offset_m", 0.005) if prismatic else Parameter("offset_rad", 0.05),)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        return np.ones((len(motion), 1))


class JointScale(EncoderEffect):
    """Wrong gear ratio or counts per turn: true angle = reading · (1 + scale_error)."""

    name = "joint_scale"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("scale_error", 0.01),)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        return motion.q[:, [place.joint]]


class JointEccentricity(EncoderEffect):
    """The magnet of the encoder sits off the axis by (sine, -cosine) of its radius.

    The field's direction is that of (cos θ, sin θ) + e, so true angle = reading + asin(sine · sin + cosine · cos).
    """

    name = "joint_eccentricity"
    turns_only = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("sine_rad", 0.02), Parameter("cosine_rad", 0.02))

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        ring = self._ring(motion, place)
        return ring / np.sqrt(1.0 - np.square(self._sine(ring, values)))[:, None]

    def correction(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        return np.arcsin(self._sine(self._ring(motion, place), values))

    def _ring(self, motion: Motion, place: Place) -> FloatArray:
        q = motion.q[:, place.joint]
        return np.stack([np.sin(q), np.cos(q)], axis=1)

    def _sine(self, ring: FloatArray, values: FloatArray) -> FloatArray:
        return np.clip(ring @ values, -_FARTHEST_OFF, _FARTHEST_OFF)


class JointRipple(EncoderEffect):
    """Gear teeth, strain wave, pole pairs: an error whose period is a fraction of a turn (of a slide: a length)."""

    name = "joint_ripple"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        if prismatic:
            cycles = Parameter("cycles_per_m", 100.0, None, smooth=True)
            return (Parameter("sine_m", 0.001), Parameter("cosine_m", 0.001), cycles)
        cycles = Parameter("cycles_per_turn", 8.0, None, smooth=True)
        return (Parameter("sine_rad", 0.01), Parameter("cosine_rad", 0.01), cycles)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        phase = motion.q[:, place.joint] * values[2] * (2.0 * np.pi if place.prismatic else 1.0)
        return np.stack([np.sin(phase), np.cos(phase), np.zeros_like(phase)], axis=1)


class JointCoupling(EncoderEffect):
    """One joint moves with another: true angle = reading + ratio · (reading of the other)."""

    name = "joint_coupling"
    takes_source = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("ratio", 0.02),)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        assert place.source is not None
        return motion.q[:, [place.source]]


class EncoderJump(EncoderEffect):
    """The zero changes at a moment: true angle = reading + jump from then on."""

    name = "encoder_jump"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (
            Parameter("jump_m", 0.005) if prismatic else Parameter("jump_rad", 0.03),
            Parameter("t0", 0.0, None),
        )

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        after = motion.clock >= values[1]
        return np.stack([after.astype(np.float64), np.zeros(len(motion))], axis=1)


class Backlash(EncoderEffect):
    """Play between encoder and joint: the joint rests until the reading has crossed the width of the play."""

    name = "backlash"
    remembers = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (
            Parameter("width_m", 0.002, never_negative=True)
            if prismatic
            else Parameter("width_rad", 0.01, never_negative=True),
        )

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        wider = self.correction(motion, place, values + _WIDTH_STEP)
        return ((wider - self.correction(motion, place, values)) / _WIDTH_STEP)[:, None]

    def correction(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        return _played(motion, place.joint, abs(float(values[0]))) * np.sign(values[0])


class Settling(EncoderEffect):
    """Read before the joint has come to rest: what is missing is a fraction of the last move, and of what was before.

    true angle = reading - e, with e_i = fraction · move_i + memory^(dt_i / usual dt) · e_{i-1}.
    """

    name = "settling"
    remembers = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("fraction", 0.05, never_negative=True), Parameter("memory", 0.0, None, smooth=True))

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        missing = _missing(motion, place.joint, float(values[1]))
        return np.stack([-missing, np.zeros_like(missing)], axis=1)


@lru_cache(maxsize=_MEMORIES_KEPT)
def _missing(motion: Motion, joint: int, memory: float) -> FloatArray:
    """What is missing of the last move and of what was before (n,); a search asks for the same ones again and again."""
    moves = motion.moves[:, joint]
    if memory == 0.0:
        return moves
    kept = np.sign(memory) * abs(memory) ** motion.pace
    kept[motion.begins] = 0.0
    missing, back = moves.copy(), 1
    # Of so many rows back, then of twice as many: `kept` is what is left of a row's own so far before.
    while back < len(missing) and np.abs(kept).max() > _FORGOTTEN:
        missing[back:] += kept[back:] * missing[:-back]
        kept[back:] *= kept[:-back]
        back *= 2
    return frozen_array(missing)


class Play:
    """A play of a width [rad, m], driven reading by reading: its output follows when the input has crossed it."""

    def __init__(self, width: float) -> None:
        self._half = 0.5 * width
        self._output: float | None = None

    def begin(self, reading: float, leading: float) -> None:
        """The input stands at `reading` and leads by half the width, in the direction of `leading`; 0: centred."""
        self._output = reading - self._half * float(np.sign(leading))

    def follow(self, reading: float) -> float:
        """The output for the next reading."""
        return self.followed([reading])[0]

    def followed(self, readings: Sequence[float]) -> list[float]:
        """The outputs for the next readings."""
        half, outputs = self._half, []
        output = readings[0] if self._output is None else self._output
        for reading in readings:
            if output < reading - half:
                output = reading - half
            elif output > reading + half:
                output = reading + half
            outputs.append(output)
        self._output = output
        return outputs


def played(q: FloatArray, width: float) -> FloatArray:
    """Output minus input (n,) of a play of `width` that is driven by q (n,), which leads in its first direction.

    Between two runs it is driven straight from the last reading of one to the first of the next: on which side it was
    left is known, and what goes far ends on the side to which it went.
    """
    moves = np.diff(q)
    leading = moves[np.flatnonzero(moves)[:1]]
    play = Play(width)
    play.begin(float(q[0]), float(leading[0]) if len(leading) else 0.0)
    return np.array(play.followed(q.tolist())) - q


@lru_cache(maxsize=_PLAYS_KEPT)
def _played(motion: Motion, joint: int, width: float) -> FloatArray:
    """`played` of one joint; a search asks for the same widths again and again."""
    return frozen_array(played(motion.q[:, joint], width))


ENCODER_EFFECTS: tuple[EncoderEffect, ...] = (
    JointOffset(),
    JointScale(),
    JointEccentricity(),
    JointRipple(),
    JointCoupling(),
    EncoderJump(),
    Backlash(),
    Settling(),
)
