"""Edit the EEPROM settings of servos: verify torque off, write, read back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Self

from bodyschema.drivers.echo import Port, without_echo
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock

from .bus import Bus, Trouble
from .config import ServoConfig
from .handshake import HandshakeSettings, identify, read_register, switch_torque_off
from .model import Model, Register
from .servo import IdentifiedServo
from .settings import ID, Setting
from .vendor import ServoVendor

LOCK = "lock"

OpenAt = Callable[[str, int], tuple[Port, float]]
"""Opens a port at a rate; with the latency of its adapter [s]."""


class Outcome(StrEnum):
    WRITTEN = "written"
    KEPT = "not written"
    OTHER = "something else stands there"
    UNKNOWN = "not known"


@dataclass(frozen=True, slots=True)
class Change:
    """A number to be written: `target` in place of `now`."""

    servo: IdentifiedServo
    setting: Setting
    now: int
    target: int


@dataclass(frozen=True, slots=True)
class WriteResult:
    """Outcome of a change."""

    change: Change
    outcome: Outcome
    found: int | None = None  # value read back; None if no servo answered
    remarks: str = ""  # explanation; empty if the value was written and read back


class EepromEditor:
    """Editor of servo EEPROM. A context manager that opens ports (its buses) on demand."""

    def __init__(self, vendor: ServoVendor, clock: Clock, open_at: OpenAt) -> None:
        self.vendor, self._clock, self._open_at = vendor, clock, open_at
        self._buses: dict[str, tuple[int, Bus]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with ExitStack() as stack:
            for _, bus in self._buses.values():
                stack.callback(bus.close)
            self._buses.clear()

    def bus(self, port: str, baud: int) -> Bus:
        """Return the bus at `port`, opened at this baud rate; raise SourceError if it cannot be opened."""
        if port in self._buses:
            rate, bus = self._buses[port]
            if rate == baud:
                return bus
            del self._buses[port]
            bus.close()
        opened, latency_s = self._open_at(port, baud)
        echo_free = without_echo(opened, self._clock, latency_s)
        self._buses[port] = (baud, self.vendor.bus(port, echo_free, self._clock, latency_s))
        return self._buses[port][1]

    def identified_servo(self, bus: Bus, config: ServoConfig, model: Model) -> IdentifiedServo:
        """Return the servo found on the bus; raise SourceError if it is a different one or does not answer."""
        finding = identify(bus, config, model, self.vendor.models)
        if finding.servo is None:
            raise SourceError(
                f"joint {config.joint!r} (ID {config.id}, {config.model}) on {bus.name}: {finding.found}. "
                "Look with `bodyschema scan` who is there; nothing was written"
            )
        return finding.servo

    def model_at(self, bus: Bus, id: int) -> Model | None:
        """Identify the model of the servo with an ID by trying all protocols of the vendor. Return None if unknown."""
        for protocol, example in self._by_protocol.items():
            register = example.layout["model"]
            data, _ = read_register(bus, example, id, register)
            model = None if data is None else self.vendor.models.get(register.value(data))
            if model is not None and model.protocol == protocol:
                return model
        return None

    def is_taken(self, bus: Bus, id: int) -> bool:
        """Return True if a servo answers to an ID in any protocol."""
        return any(bus.ping(model, id).trouble is not Trouble.TIMEOUT for model in self._by_protocol.values())

    @property
    def _by_protocol(self) -> dict[int, Model]:
        return {model.protocol: model for model in self.vendor.models.values()}

    def value(self, bus: Bus, servo: IdentifiedServo, setting: Setting) -> int:
        """Return the setting's value in the servo's EEPROM; raise SourceError if the servo does not answer."""
        return _read(bus, servo, setting.register)

    def position(self, bus: Bus, servo: IdentifiedServo) -> int:
        """Return the servo's position [ticks]; raise SourceError if it does not answer."""
        return _read(bus, servo, servo.model.layout["position"])

    def homing_offset(self, bus: Bus, servo: IdentifiedServo) -> int:
        """Return the homing offset that makes the servo's present position its `zero_ticks`, modulo full turns."""
        moved = round(servo.zero_ticks - self.position(bus, servo))
        turn = servo.ticks_per_turn
        wanted = servo.homing_offset + self.vendor.homing_sign * moved
        return wanted if turn is None else (wanted + turn // 2) % turn - turn // 2

    def torque_off(self, bus: Bus, servos: Iterable[IdentifiedServo]) -> None:
        """Switch the torque of all servos off, and verify it; raise SourceError if one stays on."""
        for servo in servos:
            switch_torque_off(bus, servo)

    def write(self, bus: Bus, change: Change) -> WriteResult:
        """Write a change and read it back. Torque must be off. For baud rates use `write_bauds`."""
        self._unlock(bus, change.servo)
        done = self._write_once(bus, change)
        for _ in range(HandshakeSettings.attempts - 1):
            if done.outcome is Outcome.KEPT:
                done = self._write_once(bus, change)
        return self._relock(bus, done)

    def write_bauds(self, port: str, baud: int, target: int, changes: Sequence[Change]) -> list[WriteResult]:
        """Change the baud rate [bit/s] of servos of one port; verify each at the new rate, otherwise at its old one."""
        bus = self.bus(port, baud)
        for change in changes:
            self._unlock(bus, change.servo)
            self._write_unanswered(bus, change.servo, change.setting.register, change.target)
        return [self._baud_result(port, baud, target, change) for change in changes]

    def _write_once(self, bus: Bus, change: Change) -> WriteResult:
        servo, register = change.servo, change.setting.register
        self._write_unanswered(bus, servo, register, change.target)
        id = change.target if change.setting.name == ID else servo.id
        data, trouble = read_register(bus, servo.model, id, register)
        if data is None and change.setting.name == ID:
            old, _ = read_register(bus, servo.model, servo.id, register)
            if old is not None:
                return WriteResult(change, Outcome.KEPT, servo.id, "the servo refuses it, and answers to its old ID")
        if data is None:
            return _unknown_result(change, trouble)
        found = register.value(data)
        if found == change.target:
            return WriteResult(change, Outcome.WRITTEN, found)
        if found == change.now:
            return WriteResult(
                change, Outcome.KEPT, found, "the servo refuses it: out of range for this model, or locked"
            )
        return WriteResult(change, Outcome.OTHER, found, f"{change.setting.shown(found)} was read back")

    def _baud_result(self, port: str, baud: int, target: int, change: Change) -> WriteResult:
        servo, register = change.servo, change.setting.register
        data, trouble = read_register(self.bus(port, target), servo.model, servo.id, register)
        if data is not None:
            return self._relock(self.bus(port, target), WriteResult(change, Outcome.WRITTEN, register.value(data)))
        data, _ = read_register(self.bus(port, baud), servo.model, servo.id, register)
        if data is not None:
            remarks = f"it still answers at {baud:,} bit/s"
            return self._relock(self.bus(port, baud), WriteResult(change, Outcome.KEPT, register.value(data), remarks))
        return _unknown_result(change, trouble)

    def _write_unanswered(
        self, bus: Bus, servo: IdentifiedServo, register: Register, value: int, deaf_s: float = 0.02
    ) -> None:
        """Write and ignore the answer: its ID and baud rate depend on the firmware."""
        bus.write(servo.model, servo.id, register, register.bytes(value))
        bus.settle()
        bus.listen(self._clock.now() + deaf_s)  # while it writes

    def _unlock(self, bus: Bus, servo: IdentifiedServo) -> None:
        """Unlock the servo's EEPROM; values written while it is locked are lost at power-off."""
        if LOCK in servo.model.layout:
            self._write_unanswered(bus, servo, servo.model.layout[LOCK], 0)

    def _relock(self, bus: Bus, done: WriteResult) -> WriteResult:
        servo = done.change.servo
        if LOCK not in servo.model.layout or done.outcome is Outcome.UNKNOWN:
            return done
        if done.change.setting.name == ID and done.outcome is Outcome.WRITTEN:
            servo = replace(servo, id=done.change.target)
        register = servo.model.layout[LOCK]
        self._write_unanswered(bus, servo, register, 1)
        data, _ = read_register(bus, servo.model, servo.id, register)
        if data == register.bytes(1):
            return done
        remarks = "its EEPROM may still be unlocked: switch its supply off and on"
        return replace(done, remarks="; ".join(filter(None, (done.remarks, remarks))))


def _unknown_result(change: Change, trouble: Trouble | None) -> WriteResult:
    remarks = f"{trouble} after it was written: look at the cable, then ask again with `bodyschema servos`"
    return WriteResult(change, Outcome.UNKNOWN, None, remarks)


def _read(bus: Bus, servo: IdentifiedServo, register: Register) -> int:
    data, trouble = read_register(bus, servo.model, servo.id, register)
    if data is None:
        raise SourceError(f"joint {servo.joint!r} (ID {servo.id}) on {bus.name}: {trouble}. Nothing was written")
    return register.value(data)
