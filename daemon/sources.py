"""What the sampler is given to read from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from interfaces.protocols import Clock, JointSource, MarkerSource
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
