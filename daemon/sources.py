"""What sampler and learner are given to read from and to publish on."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.protocols import Clock, JointSource, MarkerSource, Source
from bodyschema.interfaces.records import FloatArray
from kbmaps import RigidChain


class Simulation(Protocol):
    """A simulated world, as those see it who may know the truth."""

    def change_tool(self, marker_xyz: tuple[float, float, float]) -> float:
        """Put another tool into the hand, its marker at `marker_xyz` [m] in the marker link; the time [s] of that."""
        ...

    def true_chain(self) -> RigidChain:
        """The robot as it really is."""
        ...

    def true_turn(self) -> FloatArray:
        """How the marker really is turned on the hand, shape (3, 3)."""
        ...


@runtime_checkable
class Powered(Protocol):
    """Joints that have torque from when a person asks for it until anything is not as it must be."""

    @property
    def name(self) -> str:
        """In commands: `<name>_on`, `<name>_off`."""
        ...

    @property
    def state(self) -> str:
        """off, on, or dropped: off by itself, until somebody asks again."""
        ...

    @property
    def complaints(self) -> tuple[str, ...]:
        """What is wrong, and what to do."""
        ...

    def ask(self, on: bool) -> Future[str]:
        """Ask for torque or its end; the answer comes from the thread that reads, unless it is cancelled before."""
        ...


@runtime_checkable
class Head(Powered, Protocol):
    """A head that turns to where it is told to look."""

    @property
    def head(self) -> tuple[str, ...]:
        """Names of its joints."""
        ...

    @property
    def lower(self) -> FloatArray:
        """Their lower limits [rad] (g,)."""
        ...

    @property
    def upper(self) -> FloatArray:
        """Their upper limits [rad] (g,)."""
        ...

    @property
    def pose(self) -> tuple[float, FloatArray] | None:
        """Time [s] and angles of all joints [rad] (d,) of the newest reading; None while it has no torque."""
        ...

    def aim(self, t: float, angles: FloatArray) -> None:
        """At `t` [s] its joints should stand at `angles` (g,) [rad]."""
        ...


class TellsHealth(Protocol):
    """What can say how it is."""

    @property
    def health(self) -> Sequence[str]:
        """What is wrong, and what to do."""
        ...


@dataclass(frozen=True, slots=True)
class Sources:
    """Encoders and marker, not opened yet, on one clock; and the simulated world when there is one.

    Attributes:
        powered: what may move the arm or the head, once a person asks for it.
        head: the one of them that turns the cameras.
        cameras: what tells how the cameras are, where there are some.
        calibration: how they see, where that is not what [camera] says.
        live: neither encoders nor cameras wait for the other; else what is not read yet stays to be read.
    """

    joints: JointSource
    marker: MarkerSource
    clock: Clock
    simulation: Simulation | None = None
    powered: tuple[Powered, ...] = ()
    head: Head | None = None
    cameras: TellsHealth | None = None
    calibration: StereoCalibration | None = None
    live: bool = False


class StampedJoints(JointSource, Protocol):
    """Encoders that have a clock of their own."""

    @property
    def stamp_ns(self) -> int | None:
        """The newest reading's time on that clock [ns], or None before any."""
        ...


class MarkerTopic(Source, Protocol):
    """Takes expected positions."""

    @property
    def period_s(self) -> float:
        """No two are wanted closer together [s]."""
        ...

    @property
    def has_sigma(self) -> bool:
        """Whether listeners are told how sure a position is."""
        ...

    def publish(self, stamp_ns: int, x: FloatArray, sigma: FloatArray) -> None:
        """Tell a position [m] and its 1-sigma per axis [m], shapes (3,), at a time on the encoders' clock [ns]."""
        ...
