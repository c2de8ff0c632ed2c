"""Define how an effect is presented: as a finding, with a remedy, and with a plot of the evidence."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals
from bodyschema.diagnosis.report.result import Cause
from bodyschema.effects import Effect, corrected_file
from bodyschema.effects.effect_type import EffectType
from bodyschema.effects.motion import transforms
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.rpy import rpy_of

from .evidence import measured_against_predicted

DEG = math.degrees(1.0)


class _Settings:
    # The number of ticks a turn is stated if it is a whole number to within this share.
    whole_turn = 0.01
    # A step whose log10 is a whole number to within this is a decimal place of the file, not an encoder tick.
    decimal = 1e-3


@dataclass(frozen=True)
class FoundCause:
    """A cause with its numbers."""

    # where, source: the joint it acts on, and the joint that causes it; None without one
    where: str | None
    source: str | None
    numbers: Mapping[str, float]  # of shifts and turns, only those given count
    seen_by: str = "camera"  # the kind of measuring device, as in `DiagnosisFile`
    timed: bool = True  # True if the recording has times; otherwise a moment is a row number
    # True if the URDF states masses; otherwise compliances are those of links of an assumed weight
    weighed: bool = True

    @classmethod
    def of(cls, cause: Cause) -> FoundCause:
        return cls(cause.where, cause.source, {name: interval.value for name, interval in cause.parameters.items()})

    @property
    def at(self) -> str:
        """The joint, as in "joint elbow"."""
        return f"joint {self.where}"

    @property
    def shift(self) -> str:
        return f"{1e3 * self._size('x_m', 'y_m', 'z_m'):.3g} mm"

    @property
    def turn(self) -> str:
        return f"{self._size('rx_rad', 'ry_rad', 'rz_rad') * DEG:.2g}°"

    @property
    def shifts(self) -> list[str]:
        return [axis for axis in "xyz" if f"{axis}_m" in self.numbers]

    @property
    def turns(self) -> list[str]:
        return [axis for axis in "xyz" if f"r{axis}_rad" in self.numbers]

    @property
    def moved(self) -> str:
        return " and ".join(said for said, axes in ((self.shift, self.shifts), (self.turn, self.turns)) if axes)

    @property
    def when(self) -> str:
        """Its moment, with a preposition; empty if it is unknown."""
        if "t0" not in self.numbers:
            return ""
        return f" at {'t =' if self.timed else 'row'} {self.numbers['t0']:.1f}"

    def size(self, base: str) -> str:
        """Return the size of a number that is an angle, or a length at a prismatic joint."""
        return self.signed(base).lstrip("+")

    def signed(self, base: str) -> str:
        if f"{base}_rad" in self.numbers:
            return f"{self.numbers[f'{base}_rad'] * DEG:+.3g}°"
        return f"{self.numbers[f'{base}_m'] * 1e3:+.3g} mm"

    def _size(self, *names: str) -> float:
        return float(np.linalg.norm([self.numbers[n] for n in names if n in self.numbers]))


@dataclass(frozen=True)
class Workshop:
    """Knowledge about the robot to which a remedy is applied."""

    robot: RobotDescription  # the robot as described
    steps: FloatArray  # encoder step of each joint (d,) [rad, m]; 0 where it is unknown
    torques: FloatArray  # the largest torque of gravity on each joint (d,) [N·m, N]
    causes: Mapping[str, Cause] = field(default_factory=dict)  # all causes, by effect

    @property
    def in_urdf(self) -> str:
        return f" (--out writes {corrected_file(self.robot)}, which has it)"

    def joint(self, found: FoundCause) -> int:
        """Return the index in q of a cause's joint."""
        return self.robot.joints.index(found.where or "")

    def slides(self, found: FoundCause) -> bool:
        return bool(self.robot.chain.prismatic[self.joint(found)])

    def amount(self, found: FoundCause, base: str) -> str:
        """Return a number of a cause that is an angle or a length, with its ticks if they are known."""
        name = f"{base}_m" if self.slides(found) else f"{base}_rad"
        return f"{found.signed(base)}{self._ticks(found, found.numbers[name])}"

    def _ticks(self, found: FoundCause, amount: float) -> str:
        step = float(self.steps[self.joint(found)])
        if step <= 0.0:
            return ""
        decimals = np.log10([step, math.degrees(step)])
        if np.abs(decimals - np.round(decimals)).min() < _Settings.decimal:
            return ""
        count = round(amount / step)
        per_turn = 2.0 * math.pi / step
        of = ""
        if not self.slides(found) and abs(per_turn - round(per_turn)) < _Settings.whole_turn * per_turn:
            of = f" of {round(per_turn)} a turn"
        return f" ({count:+d} tick{'' if abs(count) == 1 else 's'}{of})"

    def pose_of(self, effect: str) -> FloatArray:
        """Return the pose (4, 4) of another cause; the identity if it was not found."""
        cause = self.causes.get(effect)
        return np.eye(4) if cause is None else pose(FoundCause.of(cause).numbers)


class Presenter(ABC):
    """Base class: sentences and a plot for one effect."""

    effect: ClassVar[str]  # name of the effect
    # the cause in a few words without figures, with {joint}, {source} and {seen_by} to fill in; if empty, the effect's
    # name
    noun: str = ""
    # plots the evidence for a cause; `panel` may do it instead
    plot: ClassVar[staticmethod[[Residuals, Effect], Panel]] = staticmethod(measured_against_predicted)

    @abstractmethod
    def finding(self, found: FoundCause) -> str:
        """Return a cause as a clause: fault, place and size."""

    @abstractmethod
    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        """Return the remedy of a cause."""

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        return self.plot(residuals, effect)


class PlainPresenter(Presenter):
    """Presenter of an effect that has none, such as one of another package."""

    def __init__(self, kind: EffectType) -> None:
        self._kind = kind
        self.noun = kind.name.replace("_", " ") + (" at joint {joint}" if kind.at_joint else "")

    def finding(self, found: FoundCause) -> str:
        return self._kind.finding("" if found.where is None else found.at, found.numbers)

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        return self._kind.remedy("" if found.where is None else found.at)


def pose(numbers: Mapping[str, float]) -> FloatArray:
    """Return the pose (4, 4) of a shift and a rotation; missing numbers are 0."""
    names = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
    return transforms(np.array([[numbers.get(name, 0.0) for name in names]]))[0]


def listed(values: FloatArray) -> str:
    """Return numbers as a list of robot.toml."""
    return f"[{', '.join(short(value, 5) for value in values.tolist())}]"


def toml_pose(T: FloatArray) -> str:
    """Return a pose (4, 4) as lines of robot.toml."""
    return f"xyz = {listed(T[:3, 3])}, rpy = {listed(rpy_of(T[:3, :3]))}"


def short(value: float, digits: int) -> str:
    """Return a number without trailing zeros."""
    return f"{round(value, digits) + 0.0:.{digits}f}".rstrip("0").rstrip(".")


def with_sign(value: float) -> str:
    """Return a number to add to another, with its sign apart."""
    return f"{'-' if value < 0 else '+'} {abs(value):.3g}"
