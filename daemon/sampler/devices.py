"""Record which devices read the joints, report changes that affect the pairs, and collect the status of servos."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import Any, Protocol, runtime_checkable

import msgspec

from bodyschema.daemon.config import Config, DaemonConfig
from bodyschema.daemon.sampler.align import JointBuffer
from bodyschema.daemon.sampler.gate import PairGate
from bodyschema.daemon.sampler.sources import ReportsHealth
from bodyschema.daemon.service.reload import reload
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.protocols import Clock, JointSource
from bodyschema.interfaces.servos import BusStatus, ServoStatus
from bodyschema.recordings.store.retention import Keep
from bodyschema.recordings.store.store import PairStore, Session
from bodyschema.robot.limited import read_at_most
from bodyschema.robot.toml_file import read_toml

log = logging.getLogger(__name__)

Device = Mapping[str, Any]

OR_NEW_STORE = "or keep it, and start again with another --state-dir"
IN_SERVO = {"homing_offset_ticks": "homing_offset", "drive_mode": "drive_mode"}
IN_ROBOT_TOML = ("zero_ticks", "direction")


@runtime_checkable
class IdentifiesDevices(Protocol):
    """Encoders that can identify themselves; see `bodyschema.drivers.servos.joints.ServoJoints`."""

    @property
    def record(self) -> Sequence[Device]:
        """For each joint: `joint`, and its identifying properties by name; empty until the devices were queried."""
        ...


class DeviceWatch:
    """Recorder of the devices that read the joints, which detects changes of them."""

    def __init__(self, joints: JointSource, store: PairStore, wall: Clock) -> None:
        """Store the settings; nothing is queried yet.

        Args:
            joints: queried if they keep a record.
        """
        self._joints = joints if isinstance(joints, IdentifiesDevices) else None
        self._store, self._wall = store, wall
        stored = store.reader.devices()
        self._previous_record: Sequence[Device] = stored[-1].record if stored else ()
        self.current_record: Sequence[Device] = ()  # the record of this session; empty before there is one
        self.changes: list[str] = []  # differences from the devices of earlier pairs, with remedies

    def check(self) -> bool:
        """Store the record if it is new; return True if pairs from now on are not comparable with earlier ones."""
        record = () if self._joints is None else self._joints.record
        if not record or record == self.current_record:
            return False
        found = differences(self._previous_record, record)
        self._store.note_devices(self._wall.utc(), record)
        self._previous_record = self.current_record = record
        for sentence in found:
            log.warning("%s", sentence)
        self.changes += found
        return bool(found)


def differences(before: Sequence[Device], now: Sequence[Device]) -> list[str]:
    """Return a sentence with a remedy for each difference between devices that affects the measurements."""
    then = {device["joint"]: device for device in before}
    return [
        sentence for device in now if device["joint"] in then for sentence in _sentences(then[device["joint"]], device)
    ]


def _sentences(before: Device, now: Device) -> Iterator[str]:
    joint, changed = now["joint"], {key for key in now if key in before and before[key] != now[key]}
    if "model" in changed:
        yield (
            f"joint {joint!r} has another servo than the samples before: {before['model']} then, {now['model']} now. "
            f"Its zero is another one: put the old one back, {OR_NEW_STORE}"
        )
        return
    for key, name in IN_SERVO.items():
        if key in changed:
            yield (
                f"the zero of {joint!r} is not what the samples before were measured with: {name} was {before[key]}, "
                f"is {now[key]}. Write it back (`bodyschema servos {name}={before[key]} --joint {joint}`), "
                f"{OR_NEW_STORE}"
            )
    for key in IN_ROBOT_TOML:
        if key in changed:
            yield (
                f"the zero of {joint!r} is not what the samples before were measured with: {key} in robot.toml was "
                f"{before[key]}, is {now[key]}. Put it back, {OR_NEW_STORE}"
            )
    if "firmware" in changed:
        yield (
            f"the firmware of {joint!r} was {before['firmware']}, is {now['firmware']}: compare its angle in a known "
            "pose with `bodyschema watch joints`; samples before may have another zero"
        )


def session_of(config: Config, wall: Clock) -> Session:
    """Return the session that starts now with `config`."""
    return Session(
        joints=config.robot.joints,
        started_utc=wall.utc(),
        robot_toml=read_toml(config.file)[1],
        urdf=read_at_most(config.robot.tree.file).decode("utf-8", errors="replace"),
        config=msgspec.json.encode(config.tables).decode(),
        version=version("bodyschema"),
        host=socket.gethostname(),
    )


TABLES = (
    *("robot", "camera", "zenoh", "daemon", "drivers", "vision", "marker_source"),
    *("sim", "effects", "background", "unexplained"),
)
CHANGEABLE = {("daemon", key) for key in DaemonConfig.__struct_fields__ if key != "state_dir"}


class SamplerRules:
    """Rules of robot.toml, applied to the sampler's parts; from any thread."""

    def __init__(
        self,
        config: Config,
        store: PairStore,
        devices: DeviceWatch,
        wall: Clock,
        *,
        gate: PairGate,
        buffer: JointBuffer,
        pair_lock: threading.Lock,  # held while a pair is decided on and stored, so that no pair sees half of a change
    ) -> None:
        self._config, self._store, self._devices, self._wall = config, store, devices, wall
        self._gate, self._buffer, self._pair_lock = gate, buffer, pair_lock
        self._reload_lock = threading.Lock()

    def reload(self) -> str:
        """Read robot.toml again and return a message about the result; sampling continues meanwhile.

        Raises:
            ConfigError: robot.toml is invalid; nothing changed.
            StoreError: the new session cannot be stored; nothing changed.
        """
        with self._reload_lock:
            found = reload(self._config, TABLES, CHANGEABLE)
            if found.changed:
                self._follow(found.config)
        return found.message("sampler")

    def trim(self) -> None:
        """Delete a batch of the pairs that are no longer kept, if there are any.

        Raises:
            StoreError: the disk is full or broken.
        """
        rules = self._config.tables.daemon
        most_bytes = None if rules.keep_mb is None else 1e6 * rules.keep_mb
        with self._pair_lock:
            deleted = self._store.trim(Keep(rules.keep_days, most_bytes), self._wall.utc())
        if deleted:
            log.info("the oldest %d samples were deleted, as [daemon] keep_days and keep_mb say", deleted)

    def _follow(self, config: Config) -> None:
        session, rules = session_of(config, self._wall), config.tables.daemon
        with self._pair_lock:
            self._store.switch_session(session)
            self._devices.current_record = ()
            self._gate.follow(rules)
            self._buffer.max_gap_s = rules.max_reading_gap_s
            self._config = config


@runtime_checkable
class Servos(ReportsHealth, Protocol):
    """Encoders that are servos; see `bodyschema.drivers.servos.joints.ServoJoints`."""

    @property
    def servo_health(self) -> Mapping[str, ServoStatus]: ...
    @property
    def bus_health(self) -> Mapping[str, BusStatus]: ...


@runtime_checkable
class NeedsTurnCount(Protocol):
    """Encoders that may have lost a joint's turn count."""

    @property
    def asks_for_turns(self) -> bool: ...
    def accept_turns(self) -> None:
        """Assume the turns nearest to the joints' last positions."""


def accept_turns(encoders: object) -> str:
    """Set lost turn counts to the turns nearest to the last positions; return a message.

    Raises:
        RequestError: no turn count was lost.
    """
    if not isinstance(encoders, NeedsTurnCount) or not encoders.asks_for_turns:
        raise RequestError("no joint has lost its turn count: there is nothing to accept")
    encoders.accept_turns()
    log.info("accept_turns: the turns nearest to where the joints were are taken")
    return "the turns nearest to where the joints were are taken; samples go on in a new segment"
