"""Watch an arm's joints while a person moves them: positions, ranges, and the motion that the URDF predicts."""

from __future__ import annotations

import math
from contextlib import ExitStack
from typing import Self

import msgspec
import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from bodyschema.cli.terminal.screen import bar, plain_table
from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.daemon.service.remedies import as_typed
from bodyschema.daemon.transport.status import JointRange
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.servos import EncoderJoints, ServoJoints
from bodyschema.interfaces.waits import Waits
from bodyschema.robot.description import RobotDescription


class _Settings:
    speed_over_s: float = 0.1
    moved_rad: float = math.radians(3.0)
    still_rad: float = math.radians(0.5)
    still_s: float = 1.0
    # [rad or m]: elasticity of a stop, resolution of an encoder
    beyond: float = 0.01
    # a marker that moved less shows no direction
    seen_m: float = 0.01
    temperature_every_s: float = 0.5  # one servo in turn


WORDS = (("forward", "back"), ("left", "right"), ("up", "down"))  # REP 103: x, y, z


class JointState(msgspec.Struct, frozen=True):
    joint: str
    id: int | None  # ID of its servo; None if it has none
    angle: float  # [rad], as in q of the pairs
    velocity: float  # [rad/s]
    current: float | None  # [A]; None where it is not measured
    temperature_c: float | None  # None until known
    # low, high: range since the start [rad]
    low: float
    high: float
    # lower, upper: the URDF's limits [rad]
    lower: float
    upper: float
    within_limits: bool  # True if it has always been within them; a wrong sign or zero shows here

    @property
    def range(self) -> JointRange:
        """The covered part of its limits."""
        return JointRange(self.low, self.high, self.lower, self.upper)


class ArmState(msgspec.Struct, frozen=True):
    """Current state of the arm."""

    joints: tuple[JointState, ...]
    moved: str  # the joint moved last, and the marker motion predicted by the URDF; empty before that
    health: tuple[str, ...]  # problems of the servos
    trouble: str | None  # reason why nothing can be read at present, or None
    signs_in: str  # where the signs and zeros of the joints are set


class JointsWatch:
    """Reader of an arm that keeps the ranges so far."""

    def __init__(self, config: Config, source: EncoderJoints, clock: Clock) -> None:
        self._robot, self._source, self._clock = config.robot, source, clock
        self._servos = source if isinstance(source, ServoJoints) else None
        drivers = config.tables.drivers
        self._signs_in = signs_in(is_ros2=drivers.ros2 is not None, is_plugin=drivers.plugin is not None)
        self._reading = ReconnectingSource(source, "the encoders", clock)
        self._opened = ExitStack()
        self._temperatures: dict[str, float | None] = dict.fromkeys(config.robot.joints)
        self._queried, self._next_s = 0, -math.inf
        self._q: FloatArray | None = None
        self._low = self._high = np.zeros(len(config.robot.joints))
        self._speeds = Speeds(len(config.robot.joints))
        self._signs = SignCheck(config.robot)

    def __enter__(self) -> Self:
        self._opened.enter_context(self._reading)
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def look(self) -> ArmState | None:
        """Read once and return the state; None until all joints are known."""
        reading = self._reading.read(Waits.poll_s)
        if reading is not None:
            self._low = reading.q if self._q is None else np.minimum(self._low, reading.q)
            self._high = reading.q if self._q is None else np.maximum(self._high, reading.q)
            self._q = reading.q
            self._speeds.take(reading.t, reading.q)
            self._signs.take(reading.t, reading.q)
            self._read_one_temperature()
        has_all = self._servos is not None or self._speeds.are_known
        return self._state(self._q) if self._q is not None and has_all else None

    def look_at_all_servos(self) -> ArmState | None:
        """Call `look` until each servo was queried for its health."""
        return [self.look() for _ in self._robot.joints][-1]

    def read_temperatures(self) -> None:
        if self._servos is not None:
            for joint in self._temperatures:
                self._temperatures[joint] = self._servos.temperature_c(joint)

    def _read_one_temperature(self) -> None:
        if self._servos is None or self._clock.now() < self._next_s:
            return
        joint = self._robot.joints[self._queried % len(self._robot.joints)]
        self._temperatures[joint] = self._servos.temperature_c(joint)
        self._queried += 1
        self._next_s = self._clock.now() + _Settings.temperature_every_s

    def _state(self, q: FloatArray) -> ArmState:
        joints = tuple(self._joint(place, float(angle)) for place, angle in enumerate(q))
        return ArmState(joints, self._signs.prediction, self._source.health, self._reading.trouble, self._signs_in)

    def _joint(self, place: int, angle: float) -> JointState:
        name = self._robot.joints[place]
        servo = None if self._servos is None else self._servos.servos[place]
        sample = None if self._servos is None else self._servos.samples.get(name)
        reported = None if servo is None or sample is None else servo.direction * sample.velocity
        low, high = float(self._low[place]), float(self._high[place])
        lower, upper = float(self._robot.lower[place]), float(self._robot.upper[place])
        return JointState(
            joint=name,
            id=None if servo is None else servo.id,
            angle=angle,
            velocity=float(self._speeds.v[place]) if reported is None else reported,
            current=None if sample is None else sample.current,
            temperature_c=self._temperatures[name],
            low=low,
            high=high,
            lower=lower,
            upper=upper,
            within_limits=lower - _Settings.beyond <= low and high <= upper + _Settings.beyond,
        )


def signs_in(*, is_ros2: bool, is_plugin: bool) -> str:
    """Return the place where the signs and zeros of the joints are set, for messages."""
    if is_ros2:
        return "[drivers.ros2.names] or the URDF: ROS 2 gives the angles with their signs and zeros"
    if is_plugin:
        return "the settings of its driver, or the URDF"
    return "direction and zero_ticks in robot.toml: direction = -1 turns it round"


class Speeds:
    """Velocities of joints whose encoders do not report them."""

    def __init__(self, d: int) -> None:
        self.v: FloatArray = np.zeros(d)  # over the last tenth of a second or more [rad/s], shape (d,)
        self.are_known = False  # True once the joints were observed long enough
        self._t, self._q = -math.inf, self.v

    def take(self, t: float, q: FloatArray) -> None:
        """Add the joint angles `q` (d,) [rad] at `t` [s]."""
        passed = t - self._t
        if passed < _Settings.speed_over_s:
            return
        if math.isfinite(passed):
            self.v, self.are_known = (q - self._q) / passed, True
        self._t, self._q = t, q


class SignCheck:
    """Prediction by the URDF of the marker's motion when one joint was moved, for the user to compare."""

    def __init__(self, robot: RobotDescription) -> None:
        # from the link that carries the cameras to the marker
        placed = robot.with_placement(np.eye(4), np.array(robot.robot.marker_xyz))
        self._robot, self._chain = robot, placed.chain
        self._begin: FloatArray | None = None
        self._rest: tuple[float, FloatArray] | None = None  # start time and position
        self.prediction = ""  # the prediction in words, for the joint moved last; empty before

    def take(self, t: float, q: FloatArray) -> None:
        """Add the joint angles `q` (d,) [rad] at `t` [s]."""
        if self._begin is None:
            self._begin = q
        if self._rest is None or np.abs(q - self._rest[1]).max() > _Settings.still_rad:
            self._rest = t, q
        moved = q - self._begin
        place = int(np.abs(moved).argmax())
        if abs(moved[place]) > _Settings.moved_rad:
            self.prediction = self._sentence(place, self._begin, float(moved[place]))
        if t - self._rest[0] > _Settings.still_s:  # at rest: any later motion is another move
            self._begin = q

    def _sentence(self, place: int, begin: FloatArray, moved: float) -> str:
        joint, turn = self._robot.joints[place], f"{math.degrees(moved):+.0f}°"
        end = begin.copy()
        end[place] += moved
        displacement = self._chain.positions(end[None])[0] - self._chain.positions(begin[None])[0]
        axis = int(np.abs(displacement).argmax())
        if abs(displacement[axis]) < _Settings.seen_m:
            direction = "counter-clockwise" if moved > 0 else "clockwise"
            return f"{joint} {turn}: by the URDF it turned {direction}, its axis pointing at you"
        word, sign = WORDS[axis][int(displacement[axis] < 0)], "+-"[int(displacement[axis] < 0)]
        parent = self._robot.camera.parent_link
        return f"{joint} {turn}: by the URDF the marker went {word} ({sign}{'xyz'[axis]} of {parent})"


HINT = "Move one joint at a time. It went the other way? Correct "


def screen(seen: ArmState) -> RenderableType:
    """Return a row for each joint, then the joint moved last and any problems."""
    numbers = ("ID", "angle", "°/s", "mA", "°C")
    table = plain_table("joint", *numbers, "covered of the URDF's range", right=numbers)
    table.columns[0].max_width = 18
    for joint in seen.joints:
        table.add_row(*_row(joint))
    lines = [Text(seen.moved, "cyan")] if seen.moved else []
    lines += [Text(f"{HINT}{seen.signs_in}.", "dim")]
    lines += [Text(_beyond(joint, seen.signs_in), "yellow") for joint in seen.joints if not joint.within_limits]
    lines += [Text(as_typed(complaint), "yellow") for complaint in seen.health]
    lines += [Text(as_typed(seen.trouble), "red")] if seen.trouble else []
    return Group(table, *lines)


def as_json(seen: ArmState) -> str:
    """Return one line of JSON."""
    return msgspec.json.encode({"schema": 1, **msgspec.to_builtins(seen)}).decode()


def _row(joint: JointState) -> tuple[str | Text, ...]:
    return (
        joint.joint,
        "-" if joint.id is None else str(joint.id),
        f"{math.degrees(joint.angle):+.1f}°",
        f"{math.degrees(joint.velocity) + 0.0:+.0f}",
        "-" if joint.current is None else f"{1e3 * joint.current:+.0f}",
        "-" if joint.temperature_c is None else f"{joint.temperature_c:.0f}",
        bar(joint.range),
    )


def _beyond(joint: JointState, signs_in: str) -> str:
    low, high, lower, upper = (f"{math.degrees(x):+.0f}°" for x in (joint.low, joint.high, joint.lower, joint.upper))
    return (
        f"{joint.joint} was from {low} to {high}, its limits are {lower} to {upper}: "
        f"look at the URDF's limits, and {signs_in}"
    )
