"""What sampler and learner are given to read from and to publish on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from interfaces.protocols import Clock, JointSource, MarkerSource, Source
from interfaces.records import FloatArray
from kbmaps import RigidChain


class Simulation(Protocol):
    """A simulated world, as those see it who may know the truth."""

    def change_tool(self, marker_xyz: tuple[float, float, float]) -> float:
        """Put another tool into the hand, its marker at `marker_xyz` [m] in the marker link; the time [s] of that."""
        ...

    def true_chain(self) -> RigidChain:
        """The robot as it really is."""
        ...


@dataclass(frozen=True, slots=True)
class Sources:
    """Encoders and marker, not opened yet, on one clock; and the simulated world when there is one."""

    joints: JointSource
    marker: MarkerSource
    clock: Clock
    simulation: Simulation | None = None


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
