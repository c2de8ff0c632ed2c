"""Interfaces of the sources that sampler and learner read, and of the topics that they publish on."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import msgspec

from bodyschema.daemon.transport.session import Request
from bodyschema.daemon.transport.wire import SCHEMA, CommandReply, decode, encode
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError, RequestError
from bodyschema.interfaces.protocols import Clock, JointSource, MarkerSource, Source
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import LONGEST_TOOL_M
from kbmaps import RigidChain

Picture = Callable[[], bytes | None]
ANSWER_S = 1.5  # less than the 2 s that a query waits


class GroundTruth(Protocol):
    """A simulated world, with access to its ground truth."""

    def change_tool(self, marker_xyz: tuple[float, float, float]) -> float:
        """Change the tool: put its marker at `marker_xyz` [m] in the marker link. Return the time [s] of the change."""
        ...

    def true_chain(self) -> RigidChain:
        """Return the robot's true kinematic chain."""
        ...

    def true_turn(self) -> FloatArray:
        """Return the true rotation of the marker on the hand, shape (3, 3)."""
        ...


@runtime_checkable
class PoweredMode(Protocol):
    """Joints that have torque from a person's request until any safety condition fails."""

    @property
    def name(self) -> str:
        """Name in commands: `<name>_on`, `<name>_off`."""
        ...

    @property
    def state(self) -> str:
        """Off, on, or dropped: switched off by itself, until requested again."""
        ...

    @property
    def complaints(self) -> tuple[str, ...]:
        """Problems, with remedies."""
        ...

    def ask(self, on: bool) -> Future[str]:
        """Request torque on or off. The reading thread answers, unless the request is cancelled before."""
        ...


@runtime_checkable
class GazeMode(PoweredMode, Protocol):
    """A head that can be aimed."""

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

    def aim(self, t: float, angles: FloatArray) -> None:
        """Request that its joints are at `angles` (g,) [rad] at `t` [s]."""


@runtime_checkable
class ReportsHealth(Protocol):
    """A device that reports its health."""

    @property
    def health(self) -> Sequence[str]:
        """Problems, with remedies."""
        ...


@dataclass(frozen=True, slots=True)
class JoinedHealth:
    """The health of several devices."""

    devices: Sequence[ReportsHealth]

    @property
    def health(self) -> tuple[str, ...]:
        """Problems of all devices, with remedies."""
        return tuple(text for device in self.devices for text in device.health)


THE_CAMERAS = "the cameras"


@dataclass(frozen=True, slots=True)
class Sources:
    """Encoders and marker, not opened yet, on one clock; and the simulated world if there is one."""

    joints: JointSource
    marker: MarkerSource
    clock: Clock
    simulation: GroundTruth | None = None
    powered: tuple[PoweredMode, ...] = ()  # drives that may move the arm or the head once a person asks for it
    head: GazeMode | None = None  # the one of them that moves the cameras
    cameras: ReportsHealth | None = (
        None  # reports the health of the cameras or of other marker sources, if there are any
    )
    marker_source_name: str = THE_CAMERAS  # name of the marker source in messages
    calibration: StereoCalibration | None = None  # the cameras' calibration, if it differs from [camera]
    # returns the newest camera picture as JPEG, or None before the first; None without cameras
    picture: Picture | None = None
    live: bool = False  # neither encoders nor cameras wait for the other; otherwise unread data is kept


def find_powered(drives: Iterable[object], name: str, file: Path) -> PoweredMode:
    """Return the arm's drive of this name; raise ConfigError if robot.toml, `file`, does not configure it."""
    for drive in drives:
        if isinstance(drive, PoweredMode) and drive.name == name:
            return drive
    remedy = f"Add the table [drivers.dynamixel.{name}]: docs/zero_force.md"
    raise ConfigError(f"{name} is not configured", file=file, remedy=remedy)


def request_power(drive: PoweredMode, *, on: bool) -> str:
    """Send a request to the reading thread and wait for its answer; cancel it on a timeout.

    Raises:
        RequestError: it is refused, or the servos are not being read.
    """
    answer = drive.ask(on)
    try:
        return answer.result(ANSWER_S)
    except TimeoutError as error:
        if not answer.cancel() and not answer.cancelled():
            raise RequestError(f"{drive.name}: being {'begun' if on else 'ended'}; see `bodyschema status`") from error
        raise RequestError(f"{drive.name}: the servos are not read at present; see `bodyschema status`") from error


class StampedJoints(JointSource, Protocol):
    """Encoders with a clock of their own."""

    @property
    def stamp_ns(self) -> int | None:
        """Time of the newest reading on that clock [ns]; None before any."""


class MarkerTopic(Source, Protocol):
    """A topic for expected positions."""

    @property
    def period_s(self) -> float:
        """Minimum interval between two positions [s]."""
        ...

    @property
    def has_sigma(self) -> bool:
        """True if messages include the uncertainty of a position."""
        ...

    def publish(self, stamp_ns: int, x: FloatArray, sigma: FloatArray) -> None:
        """Publish a position [m] and its 1-sigma per axis [m], shapes (3,), at a time on the encoders' clock [ns]."""


class ToolRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Request to mount another tool on the simulated hand. An empty request returns the truth instead."""

    tool: tuple[float, float, float]  # marker position in `marker_link`, at most 2 m from the hand [m]


class TruthReply(msgspec.Struct, frozen=True):
    """The simulated robot's ground truth: the exact chain from measurement frame to marker over the encoders' angles.

    For evaluation only.
    """

    fixed: list[list[list[float]]]  # transform before each joint, and last the marker's [m], (d + 1) × 4 × 4
    axes: list[list[float]]  # unit axis of each joint, d × 3
    prismatic: list[bool]  # d booleans
    t: float  # simulated time [s]
    turn: list[list[float]]  # marker orientation in the chain's last frame, 3 × 3
    schema: int = SCHEMA


def answer_simulation(world: GroundTruth, clock: Clock, request: Request) -> bytes:
    """Answer an empty request with the ground truth; change the tool on a `ToolRequest`.

    Raises:
        RequestError: the tool is not three finite numbers, or is longer than `LONGEST_TOOL_M`.
    """
    if not request.payload:
        chain = world.true_chain()
        turn = world.true_turn().tolist()
        truth = TruthReply(chain.fixed.tolist(), chain.axes.tolist(), chain.prismatic.tolist(), clock.now(), turn)
        return encode(truth, request.encoding)
    tool = decode(request.payload, ToolRequest, request.encoding).tool
    if not math.dist(tool, (0.0, 0.0, 0.0)) <= LONGEST_TOOL_M:
        raise RequestError(f"a tool at {list(tool)} m is not within {LONGEST_TOOL_M} m of the hand; units are metres")
    changed_at = world.change_tool(tool)
    return encode(CommandReply("tool", f"the tool in the hand changed at t = {changed_at:.3f} s"), request.encoding)
