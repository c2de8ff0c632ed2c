"""Inspect servos one by one between readings: torque, faults and supply."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bodyschema.interfaces.errors import SourceLost
from bodyschema.interfaces.protocols import Clock

from .bus import Bus, Exchange, Request
from .drive import Drive
from .handshake import FittedServo
from .health import Health, supply_of

EVERY_S = 0.1  # one servo in turn
SUPPLY_EVERY = 11  # every 11th inspection reads voltage and temperature too


class Inspection:
    """Inspector of the torque state and the health of servos."""

    def __init__(
        self,
        buses: Mapping[str, Bus],
        servos: Sequence[FittedServo],
        health: Health,
        drives: Sequence[Drive],
        clock: Clock,
    ) -> None:
        """Inspect `servos` on the open `buses`; update `health`. The `drives` may hold some of them."""
        self._buses, self._servos, self._health, self._drives = buses, servos, health, drives
        self._clock, self._next_s = clock, clock.now()
        self._looked = 0

    def go_on(self) -> None:
        """Inspect the next servo, if it is time.

        Raises:
            SourceLost: its torque is on, and none of our drives switched it on.
        """
        if self._clock.now() < self._next_s:
            return
        servo = self._servos[self._looked % len(self._servos)]
        exchange = self._ask_state(servo)
        if exchange.trouble is not None or not self._is_confirmed(servo, exchange):
            return
        self._looked += 1
        if self._looked >= len(self._servos):  # the first round is made at once
            self._next_s = self._clock.now() + EVERY_S
        self._judge(servo, exchange)
        if self._looked % SUPPLY_EVERY == 0 or not self._health.knows_supply(servo.joint):
            self._ask_supply(servo)

    def first_silent(self) -> str | None:
        """Return the first servo that does not answer when it is asked alone, and the trouble; None if all answer."""
        for servo in self._servos:
            trouble = self._ask_state(servo).trouble
            if trouble is not None:
                self._health.note_silent(servo.joint, trouble)
                return f"joint {servo.joint!r} (ID {servo.id}): {trouble}"
        return None

    def _is_confirmed(self, servo: FittedServo, exchange: Exchange) -> bool:
        """Ask again for an alert or torque where the checksum lets one in 256 wrong answers through."""
        told = _state_in(servo, exchange)
        if not any(told) or not self._buses[servo.bus].is_weak(self._state_request(servo)):
            return True
        again = self._ask_state(servo)
        return again.trouble is None and _state_in(servo, again) == told

    def _judge(self, servo: FittedServo, exchange: Exchange) -> None:
        has_torque, bits = _state_in(servo, exchange)
        if has_torque and not any(servo.joint in drive.holding for drive in self._drives):
            raise SourceLost(f"the torque of joint {servo.joint!r} was switched on by another program", retry_s=0.0)
        self._health.note_alert(servo.joint, bits)

    def _ask_supply(self, servo: FittedServo) -> None:
        bus = self._buses[servo.bus]
        exchange = bus.ask(bus.read_request(servo.model, servo.id, supply_of(servo.model)))
        if exchange.trouble is None:
            self._health.note_supply(servo.joint, servo.model, exchange.answers[0].status.data)

    def _ask_state(self, servo: FittedServo) -> Exchange:
        return self._buses[servo.bus].ask(self._state_request(servo))

    def _state_request(self, servo: FittedServo) -> Request:
        return self._buses[servo.bus].read_request(servo.model, servo.id, servo.model.layout.state)


def _state_in(servo: FittedServo, exchange: Exchange) -> tuple[int, int]:
    """Return the torque flag and the hardware error bits."""
    status, layout = exchange.answers[0].status, servo.model.layout
    has_register = "hardware_error" in layout
    bits = layout.value("hardware_error", status.data, layout.state.address) if has_register else status.error
    return layout.value("torque", status.data, layout.state.address), bits
