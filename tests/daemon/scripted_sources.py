"""Scripted encoders and marker in place of the hardware below the sampler."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from typing import Any, Self

import numpy as np

from bodyschema.daemon.sampler.sources import GroundTruth, Sources
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceEnded, SourceError
from bodyschema.interfaces.records import FloatArray, JointReading, MarkerFix, MarkerMiss, frozen_array
from bodyschema.robot.description import RobotDescription
from kbmaps import RigidChain

FRAME_S = 1 / 30
COV = frozen_array(np.eye(3) * 1e-6)

# Content of a script: an item to return, an error to raise, or an event to wait for.
Step = JointReading | MarkerFix | MarkerMiss | Exception | threading.Event


class Scripted:
    """A source that plays its script once, then ends. Errors raised by `openings` fail the opening of that number."""

    def __init__(self, script: Iterable[Step], joints: tuple[str, ...] = (), openings: Sequence[Any] = ()) -> None:
        self.joints = joints
        self._script = list(script)
        self._openings = list(openings)
        self._is_open = False
        self.opened = self.closed = 0
        self.newest_s = 0.0

    def __enter__(self) -> Self:
        failure = self._openings[self.opened] if self.opened < len(self._openings) else None
        self.opened += 1
        if failure is not None:
            raise failure
        self._is_open = True
        return self

    def __exit__(self, *error: object) -> None:
        self._is_open = False
        self.closed += 1

    def read(self, timeout_s: float) -> Any:
        if not self._is_open:
            raise SourceError("the script is not open; use it in a with statement")
        if not self._script:
            raise SourceEnded("the script is through")
        step = self._script[0]
        if isinstance(step, threading.Event):
            if not step.wait(timeout_s):
                return None
            self._script.pop(0)
            return None
        self._script.pop(0)
        if isinstance(step, Exception):
            raise step
        self.newest_s = step.t
        return step


class ScriptClock(SystemClock):
    """A clock that shows the time of the newest fix of a script."""

    def __init__(self, marker: Scripted) -> None:
        self._marker = marker

    def now(self) -> float:
        return self._marker.newest_s


class Walk:
    """An arm that moves its first joint by `step_deg` per frame, seen by perfect cameras."""

    def __init__(self, robot: RobotDescription, frames: int, step_deg: float = 1.5, start_s: float = 5.0) -> None:
        self.robot = robot
        self.t = start_s + FRAME_S * np.arange(frames)
        self.q = np.zeros((frames, len(robot.joints)))
        self.q[:, 0] = -1.0 + np.radians(step_deg) * np.arange(frames)
        self.x = robot.chain.positions(self.q)

    @property
    def readings(self) -> list[Step]:
        return [JointReading(t, frozen_array(q)) for t, q in zip(self.t.tolist(), self.q, strict=True)]

    @property
    def fixes(self) -> list[Step]:
        return [MarkerFix(t, frozen_array(x), COV) for t, x in zip(self.t.tolist(), self.x, strict=True)]

    def sources(self, *, readings: list[Step] | None = None, fixes: list[Step] | None = None) -> Sources:
        joints = Scripted(self.readings if readings is None else readings, self.robot.joints)
        marker = Scripted(self.fixes if fixes is None else fixes)
        return Sources(joints, marker, ScriptClock(marker))


class World:
    """A simulated world that only has a tool."""

    def __init__(self, chain: RigidChain) -> None:
        self._chain = chain
        self.tools: list[tuple[float, float, float]] = []

    def change_tool(self, marker_xyz: tuple[float, float, float]) -> float:
        self.tools.append(marker_xyz)
        return 1.25

    def true_chain(self) -> RigidChain:
        return self._chain

    def true_turn(self) -> FloatArray:
        return np.eye(3)


def simulated(sources: Sources, world: GroundTruth) -> Sources:
    return Sources(sources.joints, sources.marker, sources.clock, world)
