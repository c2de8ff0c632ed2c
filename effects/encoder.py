"""Model encoder errors, the first stage; each effect gives the joint's true angle minus the reading."""

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

# Step of the numerical derivative by the width of a backlash [rad, m].
_WIDTH_STEP = 1e-6
_PLAYS_KEPT, _MEMORIES_KEPT = 256, 256
_LAGS_KEPT = 256
# Share of a past move below which it is ignored.
_FORGOTTEN = 1e-17
# Upper limit of a magnet's eccentricity as a share of its radius; beyond it the encoder cannot be read.
_FARTHEST_OFF = 0.95


@dataclass(frozen=True, slots=True)
class Place:
    """Indices in q of an effect's joint and, for a coupling, of the joint that causes it."""

    joint: int
    prismatic: bool
    source: int | None = None


class EncoderEffect(ABC):
    """An error of one joint's reading.

    Attributes:
        name: as in `diagnosis.json`.
        takes_source: True if another joint causes it.
        remembers: True if it depends on earlier readings.
        turns_only: True if only a revolute joint can have it.
    """

    name: ClassVar[str]
    takes_source: ClassVar[bool] = False
    remembers: ClassVar[bool] = False
    turns_only: ClassVar[bool] = False

    @abstractmethod
    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        """Return its parameters at a revolute or prismatic joint."""

    @abstractmethod
    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        """Return derivatives (n, p) of the true angle by `values` (p,); zeros for those that are not amounts."""

    def correction(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        """Return true angle minus reading (n,) [rad, m]."""
        return self.columns(motion, place, values) @ values

    def finding(self, at: str, numbers: Mapping[str, float]) -> str:
        """Describe the error in a clause, where no specific sentence exists. `at` names the joint."""
        amounts = ", ".join(f"{name} = {value:.3g}" for name, value in numbers.items())
        return f"{at} has {self.name.replace('_', ' ')} ({amounts})"

    def remedy(self, at: str) -> str:
        """Return a remedy, where no specific one exists."""
        return f"See what could cause it at {at}; extended.toml takes it into account"


class JointOffset(EncoderEffect):
    """Constant joint offset: true angle = reading + offset."""

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
    """Encoder magnet off the axis by (sine, -cosine) of its radius.

    The field has the direction of (cos θ, sin θ) + e, so true angle = reading + asin(sine · sin + cosine · cos).
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
    """Periodic error of gear teeth, strain wave or pole pairs; its period is a fraction of a turn, or a length."""

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
    """Coupling of a joint to another: true angle = reading + ratio · (reading of the other)."""

    name = "joint_coupling"
    takes_source = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("ratio", 0.02),)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        assert place.source is not None
        return motion.q[:, [place.source]]


class EncoderJump(EncoderEffect):
    """Change of the joint offset at a moment: true angle = reading + jump from then on."""

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
    """Backlash between encoder and joint: the joint rests until the reading has crossed its width."""

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
    """Lag of a joint read before it has settled: a fraction of the last move, plus the decayed earlier lag.

    true angle = reading - e, with e_i = fraction · move_i + memory^(dt_i / usual dt) · e_{i-1}.
    """

    name = "settling"
    remembers = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("fraction", 0.05, never_negative=True), Parameter("memory", 0.0, None, smooth=True))

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        missing = _missing(motion, place.joint, float(values[1]))
        return np.stack([-missing, np.zeros_like(missing)], axis=1)


class Hysteresis(EncoderEffect):
    """Friction behind an elastic drive: the joint lags behind the reading, against the last direction (Dahl 1968).

    true angle = reading - lag · z, where z moves towards the direction of motion over `length`:
    dz = (sign(dq) - z) · |dq| / length.
    """

    name = "hysteresis"
    remembers = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        if prismatic:
            return (Parameter("lag_m", 0.001, never_negative=True), Parameter("length_m", 0.005, None, smooth=True))
        return (Parameter("lag_rad", 0.005, never_negative=True), Parameter("length_rad", 0.03, None, smooth=True))

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        strained = _strained(motion, place.joint, float(values[1]))
        return np.stack([-strained, np.zeros_like(strained)], axis=1)


class Bristle:
    """Friction strain from -1 to 1, driven reading by reading.

    Args:
        length: travel [rad, m] over which it reverses.
    """

    def __init__(self, length: float) -> None:
        self._length = length
        self._last: float | None = None
        self.strained = 0.0

    def begin(self, reading: float, leading: float) -> None:
        """Start at `reading`, reached in the direction of `leading`; 0 for no direction."""
        self._last, self.strained = reading, float(np.sign(leading))

    def follow(self, reading: float) -> float:
        """Return the strain at the next reading."""
        move = 0.0 if self._last is None else reading - self._last
        kept = float(np.exp(-abs(move) / self._length))
        self._last, self.strained = reading, float(np.sign(move)) * (1.0 - kept) + kept * self.strained
        return self.strained


@lru_cache(maxsize=_LAGS_KEPT)
def _strained(motion: Motion, joint: int, length: float) -> FloatArray:
    """Return the strain of a joint's friction (n,), from -1 to 1; it begins in the direction of the first move.

    Between two runs it is driven straight, as a backlash is.
    """
    moves = np.diff(motion.q[:, joint], prepend=motion.q[0, joint])
    leading = moves[np.flatnonzero(moves)[:1]]
    kept = np.exp(-np.abs(moves) / length)
    strained = np.sign(moves) * (1.0 - kept)
    strained[0], kept[0] = float(np.sign(leading[0])) if len(leading) else 0.0, 0.0
    return frozen_array(_carried_on(strained, kept))


def _carried_on(added: FloatArray, kept: FloatArray) -> FloatArray:
    """Solve e_i = added_i + kept_i e_{i-1} for all rows (n,); nothing is kept from before the first."""
    total, kept, back = added.copy(), kept.copy(), 1
    # Doubling: `kept` is the share of a row that remains after `back` rows.
    while back < len(total) and np.abs(kept).max() > _FORGOTTEN:
        total[back:] += kept[back:] * total[:-back]
        kept[back:] *= kept[:-back]
        back *= 2
    return total


@lru_cache(maxsize=_MEMORIES_KEPT)
def _missing(motion: Motion, joint: int, memory: float) -> FloatArray:
    """Return the lag after the last and earlier moves (n,); cached, since a search repeats the same values."""
    moves = motion.moves[:, joint]
    if memory == 0.0:
        return moves
    kept = np.sign(memory) * abs(memory) ** motion.pace
    kept[motion.begins] = 0.0
    return frozen_array(_carried_on(moves, kept))


class Play:
    """A backlash of a width [rad, m], driven reading by reading; its output moves once the input has crossed it."""

    def __init__(self, width: float) -> None:
        self._half = 0.5 * width
        self._output: float | None = None

    def begin(self, reading: float, leading: float) -> None:
        """Start with the input at `reading`, leading by half the width in the direction of `leading`; 0: centred."""
        self._output = reading - self._half * float(np.sign(leading))

    def follow(self, reading: float) -> float:
        """Return the output for the next reading."""
        return self.followed([reading])[0]

    def followed(self, readings: Sequence[float]) -> list[float]:
        """Return the outputs for the next readings."""
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
    """Return output minus input (n,) of a backlash of `width` driven by q (n,), leading in its first direction.

    Between two runs it is driven straight from the last reading of one to the first of the next: the side at the end of
        the run is known, and a long move ends on its own side.
    """
    moves = np.diff(q)
    leading = moves[np.flatnonzero(moves)[:1]]
    play = Play(width)
    play.begin(float(q[0]), float(leading[0]) if len(leading) else 0.0)
    return np.array(play.followed(q.tolist())) - q


@lru_cache(maxsize=_PLAYS_KEPT)
def _played(motion: Motion, joint: int, width: float) -> FloatArray:
    """Return `played` of one joint; cached, since a search repeats the same widths."""
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
    Hysteresis(),
)
