"""The part of a servo vendor's table in robot.toml that all vendors share."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Generic, Literal, TypeVar

import msgspec
from msgspec import Meta

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.suggest import did_you_mean
from bodyschema.robot.toml_file import NonNegative, Positive, line_in_entry, line_of

from .model import Model, no_driver


class ServoBusConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of a port with servos behind it, common to all vendors; each vendor defines the possible baud rates."""

    port: str  # best one of /dev/serial/by-id, which stays the same when it is plugged in again
    baud: int = 1_000_000  # as the servos are set [bit/s]
    # how long the adapter holds bytes back; without this key the system's value is used
    latency_ms: NonNegative | None = None


BusT = TypeVar("BusT", bound=ServoBusConfig)


def require_each(joints: Sequence[str], given: Sequence[str], what: str, table: str, file: Path, text: str) -> None:
    """Raise ConfigError if one of `joints` has no entry in the array of tables."""
    missing = [joint for joint in joints if joint not in given]
    if missing:
        raise ConfigError(
            f"no {what} in [[{table}]] for {', '.join(missing)}",
            file=file,
            line=line_of(text, tuple(table.split("."))),
            remedy="Every joint of [robot] joints needs one",
        )


class ServoConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An entry of servos: the servo of one joint."""

    joint: str  # its name in [robot] joints
    id: Annotated[int, Meta(ge=0, le=252)]  # the servo's number on its bus
    model: str  # as its maker writes it; it tells the protocol
    bus: str | None = None  # needed where there are several
    direction: Literal[1, -1] = 1  # −1 where the joint counts against the servo
    # the servo's position where the joint is at 0, also between two ticks; by default the middle of its range
    zero_ticks: int | float | None = None


class ServosConfig(msgspec.Struct, Generic[BusT], frozen=True, forbid_unknown_fields=True):
    table: ClassVar[str]
    models: ClassVar[Mapping[str, Model]]
    unsupported: ClassVar[Collection[str]] = ()

    buses: dict[str, BusT]
    servos: Annotated[tuple[ServoConfig, ...], Meta(min_length=1)]
    rate_hz: Positive = 250.0  # readings are not asked for more often than this
    # switch torque on again at the end where it was on at the start, holding the pose of the end
    restore_torque: bool = False

    def bus_of(self, servo: ServoConfig) -> str:
        """Return the name of the servo's bus."""
        return next(iter(self.buses)) if servo.bus is None else servo.bus

    def model_of(self, servo: ServoConfig) -> Model:
        return self.models[servo.model]

    def check(self, joints: Sequence[str], file: Path, text: str) -> None:
        """Raise ConfigError unless each of `joints` has one servo, with an existing bus and a unique ID on it."""
        table = f"drivers.{self.table}.servos"
        for place, what, key, remedy in self._mistakes(joints):
            raise ConfigError(what, file=file, line=line_in_entry(text, table, place, key), remedy=remedy)
        require_each(joints, [servo.joint for servo in self.servos], "servo", table, file, text)

    def _mistakes(self, joints: Sequence[str]) -> Iterator[tuple[int, str, str, str]]:
        seen_joints, seen_ids = set[str](), set[tuple[str, int]]()
        for place, servo in enumerate(self.servos):
            if servo.joint not in joints:
                yield place, f"unknown joint {servo.joint!r}", "joint", did_you_mean(servo.joint, joints)
            if servo.joint in seen_joints:
                yield place, f"a second servo for the joint {servo.joint!r}", "joint", "Give each joint one"
            if servo.model not in self.models:
                yield place, f"unknown model {servo.model!r}", "model", self._other_model(servo.model)
            if servo.bus is None and len(self.buses) != 1:
                yield place, "which bus?", "joint", f"Give bus, one of: {', '.join(self.buses)}"
            if servo.bus is not None and servo.bus not in self.buses:
                yield place, f"unknown bus {servo.bus!r}", "bus", did_you_mean(servo.bus, self.buses)
            key = (self.bus_of(servo), servo.id)
            if key in seen_ids:
                yield place, f"the ID {servo.id} is given twice on one bus", "id", "Give each servo an ID of its own"
            seen_joints.add(servo.joint)
            seen_ids.add(key)

    def _other_model(self, name: str) -> str:
        for known in self.unsupported:
            if name.replace("-", "").upper() == known.replace("-", "").upper():
                message = no_driver(known)
                return message[0].upper() + message[1:]
        return did_you_mean(name, self.models)
