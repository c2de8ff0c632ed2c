"""Hidden effects and the sizes that they are given."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .arms import Arm
from .arrays import FloatArray
from .motion import Motion

Parameters = dict[str, float]


@dataclass(frozen=True)
class Hidden:
    """One effect that was hidden.

    Attributes:
        effect: its name in the table of effects, or a name of the hider's own when `outside`.
        where: the joint it sits at, or None.
        source: the other joint of a coupling, or None.
        parameters: physical quantities; the unit is the end of each name, SI without one.
        sign: meaning of positive parameters.
        outside: True if it is in no table and should be called unexplained.
        drivers: with `outside`, the joints on which the hidden error itself depends.
        size: RMS of the noise-free residual of the nominal chain under this effect alone, whitened: 1 is as large as
            the noise along each axis, that of pixels and of ticks.
        rms_m: the same residual in metres.
        shows_on: with `outside`, for each joint the share (0..1) of that residual's variance that is lost when only
            this joint is resampled.
    """

    effect: str
    where: str | None
    source: str | None
    parameters: Parameters
    sign: str
    outside: bool = False
    drivers: tuple[str, ...] = ()
    size: float = math.nan
    rms_m: float = math.nan
    shows_on: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Site:
    """Joints and motion for which an effect is generated."""

    arm: Arm
    motion: Motion
    where: str | None
    source: str | None

    @property
    def prismatic(self) -> bool:
        """True if the joint is prismatic."""
        return self.where is not None and self.arm.joint(self.where).kind == "prismatic"

    @property
    def unit(self) -> str:
        """Unit of the joint's position as the end of a parameter's name."""
        return "m" if self.prismatic else "rad"

    @property
    def duration_s(self) -> float:
        """From the first to the last pair."""
        return float(self.motion.stamps[-1] - self.motion.stamps[0])


@dataclass(frozen=True)
class Kind:
    """One kind of effect.

    Attributes:
        at: "joint" (any), "pair" (a joint and a source), "robot" (no joint).
        amplitudes: the parameters that are scaled to reach a size; the others are its shape.
        draw: parameters of unit amplitude.
        most: largest value of any amplitude.
        sign: meaning of positive parameters.
        bears: possible only if the joints carry the arm's weight.
        styles: the kinds of motion that show it.
        outside, drivers: True if it is in no table, and the joints on which its error then depends.
        beside_only: possible only if the cameras stand beside the arm.
    """

    at: str
    amplitudes: tuple[str, ...]
    draw: Callable[[Site, np.random.Generator], Parameters]
    most: float
    sign: str
    bears: bool = False
    styles: tuple[str, ...] = ("walk", "stepped", "held")
    outside: bool = False
    drivers: Callable[[Site], tuple[str, ...]] | None = None
    beside_only: bool = False

    def scaled(self, parameters: Parameters, factor: float) -> tuple[Parameters, bool]:
        """Return the parameters with amplitudes scaled by `factor`, and True if the upper limit was reached."""
        largest = max(abs(parameters[name]) for name in self.amplitudes if name in parameters)
        allowed = min(factor, self.most / largest)
        scaled = {name: value * (allowed if name in self.amplitudes else 1.0) for name, value in parameters.items()}
        return scaled, allowed < factor


def moment(site: Site, rng: np.random.Generator) -> float:
    """Return a random time in the middle three fifths of the recording, between two pairs [s]."""
    count = len(site.motion.stamps)
    index = int(rng.integers(max(1, count // 5), max(2, 4 * count // 5)))
    return float(site.motion.stamps[index - 1 : index + 1].mean())


def sign(rng: np.random.Generator) -> float:
    """Return +1 or -1 at random."""
    return float(rng.choice([-1.0, 1.0]))


def direction(rng: np.random.Generator, size: int = 3) -> FloatArray:
    """Return a random unit vector."""
    v = rng.normal(size=size)
    return v / np.linalg.norm(v)
