"""An emulated ROS 2 robot in virtual time, and its reader."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from random import Random

from spoilt_messages import Fault, Planned
from virtual_link import VirtualLink, at_once
from virtual_port import VirtualClock

from bodyschema.drivers.ros2.config import Ros2Config
from bodyschema.drivers.ros2.emulator.node import Node
from bodyschema.drivers.ros2.joints import Ros2Joints
from bodyschema.interfaces.records import JointReading

PATHS: dict[str, Callable[[float], float]] = {
    "pan": lambda t: 1.2 * math.sin(0.7 * t),
    "lift": lambda t: 0.5 + 1.2 * math.sin(0.7 * t + 1.0),
    "elbow": lambda t: 1.2 * math.sin(0.7 * t + 2.0),
}


class Robot:
    """A driver connected to nodes: by default one that publishes three joints at 100 Hz."""

    def __init__(
        self,
        nodes: Sequence[Node] | None = None,
        *,
        joints: Sequence[str] = ("elbow", "pan", "lift"),
        paths: Mapping[str, Callable[[float], float]] = PATHS,
        delay: Callable[[], float] = at_once,
        share: float = 0.0,
        kinds: tuple[Fault, ...] = tuple(Fault),
        drift: float = 0.0,
        prismatic: Sequence[bool] | None = None,
        seed: int = 0,
        **settings,
    ) -> None:
        self.clock, self.paths = VirtualClock(), dict(paths)
        self.faults = Planned(Random(seed), share=share, kinds=kinds)
        self.nodes = [Node(paths, 100.0, send=self.faults, drift=drift)] if nodes is None else list(nodes)
        self.link = VirtualLink(self.nodes, self.clock, delay=delay)
        self.joints = Ros2Joints(
            Ros2Config(**settings), joints, self.clock, prismatic=prismatic, open_link=lambda *_: self.link
        )

    def read(self, seconds: float) -> list[JointReading]:
        """Return all readings of this time span."""
        end, readings = self.clock.now() + seconds, []
        while (left := end - self.clock.now()) > 1e-9:
            reading = self.joints.read(left)
            if reading is not None:
                readings.append(reading)
        return readings

    def error(self, reading: JointReading) -> float:
        """Return the largest error of the reading's positions against the truth at its time [rad]."""
        names = self.joints.joints
        return max(abs(q - self.paths[name](reading.t)) for q, name in zip(reading.q, names, strict=True))
