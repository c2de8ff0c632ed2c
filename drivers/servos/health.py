"""Reported state of servos and buses."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

from bodyschema.drivers.servos.bus import Bus, Exchange, Request
from bodyschema.drivers.servos.scan import VOLT_PER_UNIT
from bodyschema.interfaces.errors import SourceLost
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.servos import ServoStatus

from .channel import Sample, TorqueController
from .model import Register
from .servo import IdentifiedServo

log = logging.getLogger(__name__)


class Health:
    """State of the servos of an arm.

    Attributes:
        supplies: voltage [V] and temperature [°C] of the servos, if known, by joint.
        absent: reason why a servo was not found, by joint.
        away: names of the buses whose ports cannot be opened.
    """

    def __init__(self, errors: Mapping[int, str]) -> None:
        """Start without reports; `errors` are the meaning and remedy of each bit of the hardware error."""
        self._errors = errors
        self._alerts: dict[str, int] = {}
        self.supplies: dict[str, tuple[float, float]] = {}
        self.absent: dict[str, str] = {}
        self.away: set[str] = set()

    @property
    def complaints(self) -> tuple[str, ...]:
        """Current problems of servos, with the remedy."""
        return tuple(f"joint {joint!r}: {'; '.join(self._reasons(bits))}" for joint, bits in list(self._alerts.items()))

    def note_alert(self, joint: str, bits: int) -> None:
        """Update the hardware error bits of a servo, and log changes."""
        if self._alerts.get(joint, 0) == bits:
            return
        if bits:
            self._alerts[joint] = bits
            log.warning("joint %r: %s", joint, "; ".join(self._reasons(bits)))
        else:
            del self._alerts[joint]
            log.info("joint %r is well again", joint)

    def of(self, servo: IdentifiedServo, sample: Sample | None, lost: str | None) -> ServoStatus:
        """Return the state of a servo; `lost` is the joint that lost its turn count."""
        joint = servo.joint
        voltage, temperature = self.supplies.get(joint, (None, None))
        troubles = self._reasons(self._alerts.get(joint, 0))
        if joint == lost:
            troubles.append("its turn count is lost: turn it back, or say that it is right")
        if joint in self.absent:
            troubles = [f"{self.absent[joint]}: look at its supply and cable, and those of the one before it"]
        if servo.bus in self.away:
            troubles = ["its bus is away: look at the adapter's cable"]
        current = None if sample is None else sample.current
        return ServoStatus(
            bus=servo.bus,
            id=servo.id,
            model=servo.model.name,
            firmware=servo.firmware,
            homing_offset=servo.homing_offset,
            drive_mode=servo.drive_mode,
            voltage_v=None if voltage is None else round(voltage, 1),
            temperature_c=temperature,
            current_a=None if current is None else round(current, 3),
            troubles=troubles,
        )

    def _reasons(self, bits: int) -> list[str]:
        known = [text for bit, text in self._errors.items() if bits & bit]
        return known or ([f"hardware error {bits:#04x}"] if bits else [])


class _Settings:
    every_s: float = 0.1  # one servo in turn
    supply_every: int = 11  # every 11th inspection reads voltage and temperature too


class Inspection:
    """Inspector of the torque state and the health of servos."""

    def __init__(
        self,
        buses: Mapping[str, Bus],
        servos: Sequence[IdentifiedServo],
        health: Health,
        drives: Sequence[TorqueController],
        clock: Clock,
    ) -> None:
        """Inspect `servos` on the open `buses`; update `health`. The `drives` may hold some of them."""
        self._buses, self._servos, self._health, self._drives = buses, servos, health, drives
        self._clock, self._next_s = clock, clock.now()
        self._inspected = 0

    def inspect_next(self) -> None:
        """Inspect the next servo if it is due.

        Raises:
            SourceLost: its torque is on, and none of our drives switched it on.
        """
        if self._clock.now() < self._next_s:
            return
        servo = self._servos[self._inspected % len(self._servos)]
        exchange = self._ask_state(servo)
        if exchange.trouble is not None or not self._is_confirmed(servo, exchange):
            return
        self._inspected += 1
        if self._inspected >= len(self._servos):  # the first round is made at once
            self._next_s = self._clock.now() + _Settings.every_s
        self._check_state(servo, exchange)
        if self._inspected % _Settings.supply_every == 0 or servo.joint not in self._health.supplies:
            self._ask_supply(servo)

    def first_silent(self) -> str | None:
        """Return the first servo that does not answer when it is asked alone, and the trouble; None if all answer."""
        for servo in self._servos:
            trouble = self._ask_state(servo).trouble
            if trouble is not None:
                self._health.absent[servo.joint] = trouble
                return f"joint {servo.joint!r} (ID {servo.id}): {trouble}"
        return None

    def _is_confirmed(self, servo: IdentifiedServo, exchange: Exchange) -> bool:
        """Confirm an alert or torque by asking again if the checksum lets one in 256 wrong answers through."""
        state = _state_in(servo, exchange)
        if not any(state) or not self._buses[servo.bus].is_weak(self._state_request(servo)):
            return True
        again = self._ask_state(servo)
        return again.trouble is None and _state_in(servo, again) == state

    def _check_state(self, servo: IdentifiedServo, exchange: Exchange) -> None:
        has_torque, bits = _state_in(servo, exchange)
        if has_torque and not any(servo.joint in drive.holding for drive in self._drives):
            raise SourceLost(f"the torque of joint {servo.joint!r} was switched on by another program", retry_s=0.0)
        self._health.note_alert(servo.joint, bits)

    def _ask_supply(self, servo: IdentifiedServo) -> None:
        bus, layout = self._buses[servo.bus], servo.model.layout
        first = layout["voltage"].address
        supply = Register(first, layout["temperature"].end - first)
        exchange = bus.ask(bus.read_request(servo.model, servo.id, supply))
        if exchange.trouble is None:
            data = exchange.answers[0].status.data
            volts = VOLT_PER_UNIT * layout.value("voltage", data, first)
            self._health.supplies[servo.joint] = (volts, float(layout.value("temperature", data, first)))

    def _ask_state(self, servo: IdentifiedServo) -> Exchange:
        return self._buses[servo.bus].ask(self._state_request(servo))

    def _state_request(self, servo: IdentifiedServo) -> Request:
        return self._buses[servo.bus].read_request(servo.model, servo.id, servo.model.layout.state)


def _state_in(servo: IdentifiedServo, exchange: Exchange) -> tuple[int, int]:
    return servo.model.layout.torque_and_errors(exchange.answers[0].status)
