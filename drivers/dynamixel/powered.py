"""Joints that may have torque while they are read: on request, monitored, and released at any doubt."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from queue import SimpleQueue
from typing import Literal

import numpy as np

from bodyschema.drivers.servos.bus import Bus as ServoBus
from bodyschema.drivers.servos.channel import Sample
from bodyschema.drivers.servos.handshake import HandshakeSettings, switch_torque_off
from bodyschema.drivers.servos.model import Register
from bodyschema.drivers.servos.servo import IdentifiedServo
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, JointReading

from .bus import Bus
from .guard import Drop, Guard, GuardSettings, Motion, ServoState
from .models import HARDWARE_ERRORS
from .powered_config import PoweredConfig

log = logging.getLogger(__name__)


State = Literal["off", "on", "dropped"]


class PoweredJoints(ABC):
    """Joints of an arm that have torque from a user's request until any check fails.

    A `TorqueController`. Only a new request switches torque on again. `ask` and the properties may be used from any
    thread; all else belongs to the reading thread.
    """

    name: str
    """What messages call it, and the commands: `<name>_on`, `<name>_off`."""
    mode: int
    """Operating Mode that its servos have to be in."""
    mode_name: str
    goal: str
    """The register that it writes."""

    def __init__(self, config: PoweredConfig, joints: Sequence[str], guard: Guard, clock: Clock) -> None:
        self._config, self._guard, self._clock = config, guard, clock
        self._joints = tuple(joints)
        self._requests: SimpleQueue[tuple[bool, Future[str]]] = SimpleQueue()
        self._buses: dict[str, Bus] = {}
        self._servos: list[IdentifiedServo] = []
        self._places: list[int] = []
        self._sent: dict[str, int] = {}
        self._looked, self._next_look = 0, -math.inf
        self._missed: dict[str, int] = {}
        self._unverified: tuple[str, ...] = ()
        self._why, self._has_just_begun = "", False
        self.state: State = "off"

    def ask(self, on: bool) -> Future[str]:
        """Request torque on or off. The reading thread does it and returns what it did, or raises RequestError.

        A caller that stops waiting for the answer must cancel it, so that torque does not go on unexpectedly.
        """
        answer: Future[str] = Future()
        self._requests.put((on, answer))
        return answer

    @property
    def holding(self) -> frozenset[str]:
        return frozenset(self._joints) if self.state == "on" else frozenset()

    @property
    def complaints(self) -> tuple[str, ...]:
        messages = []
        if self._unverified:
            messages.append(
                f"the torque of {', '.join(self._unverified)} could not be verified off: switch the supply off"
            )
        if self.state == "dropped":
            messages.append(
                f"{self.name} ended, torque off: {self._why}. Then ask again: `bodyschema command {self.name}_on`"
            )
        return tuple(messages)

    # --- `TorqueController`, by the thread that reads

    def open(self, buses: Mapping[str, ServoBus], servos: Sequence[IdentifiedServo]) -> None:
        self._buses = {name: bus for name, bus in buses.items() if isinstance(bus, Bus)}
        by_joint = {servo.joint: place for place, servo in enumerate(servos)}
        self._places = [by_joint[joint] for joint in self._joints]
        self._servos = [servos[place] for place in self._places]
        self._unverified = ()  # all were verified off
        for servo in self._servos:
            if servo.operating_mode != self.mode:
                log.warning("%s is not possible as yet: %s", self.name, self._wrong_mode(servo, servo.operating_mode))

    def step(self, reading: JointReading | None, samples: Mapping[str, Sample | None]) -> str | None:
        self._has_just_begun = False
        self._answer_requests()
        if self.state != "on" or self._has_just_begun:
            return None  # the samples predate the torque, with which a position may lose its turns
        try:
            now = self._clock.now()
            motion = self._motion(reading, samples)
            self._guard.check(now, motion)
            if motion is not None and reading is not None:
                self._sent = dict(zip(self._joints, self._goals(now, reading.q, samples), strict=True))
                self._write_all(self.goal, self._sent)
            if now >= self._next_look:
                self._inspect_one(now)
        except Drop as drop:
            self._drop(str(drop))
            return str(drop)
        except BaseException as error:
            self._drop(str(error) or type(error).__name__)
            raise
        return None

    def release(self, why: str | None) -> None:
        for _, answer in self._pending():
            answer.set_exception(RequestError(f"{self.name}: {why or 'the servos were closed'}"))
        if self.state == "on" and why is not None:
            self._drop(why)
        elif self.state == "on" and self._end():
            log.error("%s", "; ".join(self.complaints))

    # --- differs by kind of drive

    @abstractmethod
    def _prepare(self, servo: IdentifiedServo) -> int:
        """Check the servo's own limits and return a goal with which its torque is safe to switch on.

        Raise RequestError if the limits do not allow it.
        """

    @abstractmethod
    def _begin(self, now: float) -> None:
        """Note that torque is on from `now`."""

    @abstractmethod
    def _goals(self, now: float, q: FloatArray, samples: Mapping[str, Sample | None]) -> list[int]:
        """Return the goal registers, joint by joint; q (d,) are the angles of the whole arm [rad]; raise Drop."""

    @abstractmethod
    def _on_message(self) -> str:
        """Return the message for the user who requested it."""

    # --- torque on

    def _pending(self) -> Iterator[tuple[bool, Future[str]]]:
        """Yield the requests that no caller has given up."""
        while not self._requests.empty():
            on, answer = self._requests.get_nowait()
            if answer.set_running_or_notify_cancel():
                yield on, answer

    def _answer_requests(self) -> None:
        for on, answer in self._pending():
            try:
                answer.set_result(self._switch_on() if on else self._switch_off())
            except RequestError as error:
                answer.set_exception(error)
            except BaseException as error:
                answer.set_exception(error)
                raise

    def _switch_off(self) -> str:
        if self._end():
            raise RequestError("; ".join(self.complaints))
        return f"{self.name} is off, the torque of {', '.join(self._joints)} verified off"

    def _end(self) -> tuple[str, ...]:
        """Switch torque off on request; return the joints whose torque could not be verified off."""
        unverified = self._let_go()
        self.state, self._why = "off", ""
        if not unverified:
            log.info("%s was ended; torque is verified off", self.name)
        return unverified

    def _switch_on(self) -> str:
        if self.state == "on":
            return f"{self.name} is on already"
        try:
            self._sent = {servo.joint: self._prepared(servo) for servo in self._servos}
            self.state = "on"
            self._write_all("torque", dict.fromkeys(self._joints, 1))
            for servo in self._servos:
                if self._read(servo, "torque") != 1:
                    raise RequestError(f"joint {servo.joint!r}: its torque does not go on. `bodyschema doctor`")
        except BaseException:
            self._let_go()
            self.state = "off"
            raise
        now = self._clock.now()
        self._guard.begin(now)
        self._missed, self._next_look, self._why, self._has_just_begun = {}, now, "", True
        self._begin(now)
        log.warning("%s is on: %s have torque", self.name, ", ".join(self._joints))
        return self._on_message()

    def _prepared(self, servo: IdentifiedServo) -> int:
        """Check that torque is off and the mode right, set a safe goal and arm the watchdog; return the goal."""
        if self._read(servo, "torque") != 0:
            raise RequestError(f"joint {servo.joint!r} has torque already: another program moves it")
        mode = self._read(servo, "operating_mode")
        if mode != self.mode:
            raise RequestError(self._wrong_mode(servo, mode))
        goal = self._prepare(servo)
        # After a change of mode the goal current is the highest possible (e-Manual, Operating Mode).
        for name, value in (("watchdog", 0), (self.goal, goal), ("watchdog", self._config.watchdog)):
            self._write(servo, name, value)
        return goal

    def _wrong_mode(self, servo: IdentifiedServo, found: int) -> str:
        return (
            f"joint {servo.joint!r} (ID {servo.id}) is in operating mode {found}, not {self.mode_name} ({self.mode}). "
            f"It is kept in the servo's EEPROM; type: "
            f"`bodyschema servos operating_mode={self.mode} --joint {servo.joint}`"
        )

    # --- torque off

    def _drop(self, why: str) -> None:
        self._let_go()
        self.state, self._why = "dropped", why
        log.error("%s", "; ".join(self.complaints))

    def _let_go(self) -> tuple[str, ...]:
        """Switch torque off on all servos at once, then verify each; return the joints that could not be verified."""
        # A failure of one servo must not keep the others from being switched off.
        with suppress(Exception):
            self._write_all("torque", dict.fromkeys(self._joints, 0))
        unverified = []
        for servo in self._servos:
            bus = self._buses[servo.bus]
            try:
                switch_torque_off(bus, servo)
            except Exception as error:
                log.debug("the torque of %s is not verified: %r", servo.joint, error)
                unverified.append(servo.joint)
                continue
            with suppress(Exception):
                self._write(servo, "watchdog", 0)
        self._unverified = tuple(unverified)
        return self._unverified

    # --- each cycle

    def _motion(self, reading: JointReading | None, samples: Mapping[str, Sample | None]) -> Motion | None:
        newest = [samples[joint] for joint in self._joints]
        known = [sample for sample in newest if sample is not None]
        if reading is None or len(known) < len(newest):
            return None
        return Motion(
            reading.t,
            reading.q[self._places],
            np.array([sample.velocity for sample in known]),
            np.array([sample.current or 0.0 for sample in known]),
            [sample.alert for sample in known],
        )

    def _inspect_one(self, now: float) -> None:
        servo = self._servos[self._looked % len(self._servos)]
        self._looked, self._next_look = self._looked + 1, now + GuardSettings.look_every_s
        layout = servo.model.layout
        begin = layout["torque"].address
        span = Register(begin, layout["temperature"].end - begin)
        bus = self._buses[servo.bus]
        exchange = bus.ask(bus.read_request(servo.model, servo.id, span))
        if exchange.trouble is not None:
            self._missed[servo.joint] = self._missed.get(servo.joint, 0) + 1
            if self._missed[servo.joint] >= HandshakeSettings.attempts:
                raise Drop(f"joint {servo.joint!r}: its servo does not report its state: {exchange.trouble}")
            return
        self._missed[servo.joint] = 0
        data = exchange.answers[0].status.data
        values = {name: layout.value(name, data, begin) for name in ("torque", "hardware_error", "watchdog", self.goal)}
        state = ServoState(
            has_torque=values["torque"] == 1,
            trouble="; ".join(text for bit, text in HARDWARE_ERRORS.items() if values["hardware_error"] & bit),
            watchdog=values["watchdog"],
            took_goal=values[self.goal] == self._sent[servo.joint],
            temperature_c=float(layout.value("temperature", data, begin)),
        )
        self._guard.check_servo(servo.joint, state)

    # --- registers

    def _write_all(self, name: str, values: Mapping[str, int]) -> None:
        """Write with Sync Write: the servos of one series on a bus at the same time."""
        groups: dict[tuple[str, Register], dict[int, int]] = {}
        for servo in self._servos:
            key = (servo.bus, servo.model.layout[name])
            groups.setdefault(key, {})[servo.id] = values[servo.joint]
        for (bus, register), by_id in groups.items():
            self._buses[bus].sync_write(register, by_id)

    def _write(self, servo: IdentifiedServo, name: str, value: int) -> None:
        """Write a register and read it back; raise RequestError if the value differs."""
        register = servo.model.layout[name]
        found = None
        for _ in range(HandshakeSettings.attempts):
            self._buses[servo.bus].write(servo.model, servo.id, register, register.bytes(value))
            found = self._read(servo, name)
            if found == value:
                return
        raise RequestError(f"joint {servo.joint!r} (ID {servo.id}): {name} was set to {value} and is {found}")

    def _read(self, servo: IdentifiedServo, name: str) -> int:
        """Return the value of a register; raise RequestError without an answer."""
        bus, register = self._buses[servo.bus], servo.model.layout[name]
        exchange = None
        for _ in range(HandshakeSettings.attempts):
            exchange = bus.ask(bus.read_request(servo.model, servo.id, register))
            if exchange.trouble is None:
                return register.value(exchange.answers[0].status.data)
        raise RequestError(f"joint {servo.joint!r} (ID {servo.id}): {exchange.trouble if exchange else 'no answer'}")
