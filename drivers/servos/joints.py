"""An arm of bus servos of any vendor as a `JointSource`.

`daemon/sampler/sampler.py` turns its readings into pairs.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import zip_longest
from typing import Any, Self

from bodyschema.drivers.echo import Port, close_quietly, without_echo
from bodyschema.drivers.serial_line import SerialLine, adapter_latency_s
from bodyschema.drivers.speed_gate import FASTEST_RAD_S, SpeedGate
from bodyschema.drivers.turn_count import LOST_AFTER_S, TurnCount
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import JointReading, frozen_array
from bodyschema.interfaces.servos import BusStatus, ServoStatus

from .bus import Bus, Counts, Request
from .channel import Channel, Punctuality, Sample, TorqueController, middle
from .config import ServoBusConfig, ServosConfig
from .handshake import HandshakeSettings, identify, require_all, restore_torque, switch_torque_off
from .health import Health, Inspection
from .servo import IdentifiedServo
from .vendor import ReadPlan, ServoVendor, plans_of

log = logging.getLogger(__name__)


class _Settings:
    # this many must fail as well: the program itself may have been delayed
    few_polls: int = 3
    # consecutive implausible answers after which the servo was restarted
    rejected_in_a_row: int = 5
    anchor_polls: int = 50
    slack_ticks: int = 3
    improve_every_s: float = 10.0  # a failed attempt costs a reading or two


GOLDEN = 0.618034  # its multiples, modulo 1, are spread most evenly

OpenPort = Callable[[Any, Clock], tuple[Port, float]]
"""Opens the port of a bus; with the latency of its adapter [s]."""


def open_serial(config: ServoBusConfig, clock: Clock) -> tuple[Port, float]:
    """Open the port of a bus; return it and the latency of its adapter [s]."""
    latency_s = adapter_latency_s(config.port) if config.latency_ms is None else config.latency_ms * 1e-3
    return SerialLine.open(config.port, config.baud, clock.now), latency_s


class ServoJoints:
    """Reader of the positions of an arm with torque off, except for joints held by `drives`.

    A reading consists of intact answers of all servos to the same requests, with plausible times and positions.
    Anything doubtful is dropped, and the line has to be silent before the next request. SourceLost is raised when there
    is no reading for a quarter of a second, when a servo was restarted, or when its torque is on. When it is opened
    again, everything is verified again, and the positions are compared with the last ones.

    Attributes:
        joints: names of the joints in the order of q.
        drives: may move the joints on request.
        servos: as found at the last opening, in the order of the joints.
        epoch: number of openings. Only the comparison above connects positions of different epochs.
    """

    vendor: ServoVendor

    def __init__(
        self,
        config: ServosConfig[Any],  # checked; see `ServosConfig.check`
        joints: Sequence[str],
        clock: Clock,
        *,
        open_port: OpenPort = open_serial,
        # of each joint [rad]; a range below one turn determines the turn
        limits: Sequence[tuple[float, float]] | None = None,
        last_pose: Sequence[float] | None = None,  # last joint angles [rad], shape (d,), from which turns are counted
        drives: Sequence[TorqueController] = (),  # may move joints on request; without any, torque stays off
    ) -> None:
        self._config, self.joints, self._clock = config, tuple(joints), clock
        self._open_port, self.drives = open_port, tuple(drives)
        by_joint = {servo.joint: servo for servo in config.servos}
        self._configured = [by_joint[joint] for joint in joints]
        unlimited = [(-math.inf, math.inf)] * len(joints)
        self._turns = TurnCount(limits or unlimited, last_pose)
        self._buses: dict[str, Bus] = {}
        self._plans: dict[str, ReadPlan] = {}
        self._opened = ExitStack()
        self._is_open = self._is_lost = False
        self._had_torque: set[str] = set()
        self._channels: list[Channel] = []
        self._place_of: dict[tuple[str, int], int] = {}
        self._last_t = -math.inf
        self._health = Health(self.vendor.errors)
        self._counts = {name: Counts() for name in config.buses}
        self.servos: list[IdentifiedServo] = []
        self.epoch = self.dropped = 0

    @property
    def health(self) -> tuple[str, ...]:
        """Current problems of servos, with the remedy."""
        of_drives = (text for drive in self.drives for text in drive.complaints)
        return (*self._health.complaints, *self._slow, *of_drives)

    @property
    def servo_health(self) -> Mapping[str, ServoStatus]:
        """State of each servo, by joint; empty before the first opening. From any thread."""
        samples, lost = self.samples, self._turns.lost
        return {servo.joint: self._health.of(servo, samples.get(servo.joint), lost) for servo in list(self.servos)}

    @property
    def bus_health(self) -> Mapping[str, BusStatus]:
        """Statistics of each bus since the start, by name. From any thread."""
        found = dict[str, BusStatus]()
        for name, counts in self._counts.items():
            troubles = {str(trouble): count for trouble, count in list(counts.troubles.items())}
            answered = 1.0 - sum(troubles.values()) / counts.exchanges if counts.exchanges else 0.0
            read_method = self._plans[name].name if name in self._plans else ""
            found[name] = BusStatus(counts.exchanges, round(answered, 5), troubles, read_method)
        return found

    @property
    def samples(self) -> Mapping[str, Sample | None]:
        """The newest accepted answer of each joint, even if other joints did not answer."""
        return {channel.servo.joint: channel.newest for channel in list(self._channels)}

    @property
    def asks_for_turns(self) -> bool:
        """True if it cannot be opened because a joint lost its turn count."""
        return self._turns.lost is not None

    def accept_turns(self) -> None:
        """Accept the turns nearest to the last pose at the next opening. May be called from any thread."""
        self._turns.accept()

    @property
    def record(self) -> tuple[Mapping[str, object], ...]:
        """Identity and settings of each servo, to be stored with the data."""
        return tuple(servo.record() for servo in self.servos)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._open_buses(stack)
            config = self._config
            findings = [
                identify(self._buses[config.bus_of(servo)], servo, config.model_of(servo), self.vendor.models)
                for servo in self._configured
            ]
            self._health.absent = {each.config.joint: each.found for each in findings if each.servo is None}
            servos = require_all(findings, ", ".join(bus.port for bus in config.buses.values()))
            self.servos = [switch_torque_off(self._buses[servo.bus], servo) for servo in servos]
            self._prepare()
            self._anchor()
            stack.callback(self._restore)
            for drive in self.drives:
                drive.open(self._buses, self.servos)
            stack.callback(self._release, None)
            self._opened = stack.pop_all()
        self._is_open, self._is_lost = True, False
        self._had_torque.update(servo.joint for servo in self.servos if servo.had_torque)
        self.epoch += 1
        self._log_opened()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_open = False
        self._opened.close()

    def read(self, timeout_s: float) -> JointReading | None:
        """Return the next reading; see `JointSource.read`.

        Raises:
            SourceLost: a port is gone, or a servo no longer answers, was restarted, or has torque.
        """
        if not self._is_open:
            raise SourceError("the servos are not open; use them in a with statement")
        try:
            return self._read_until(self._clock.now() + timeout_s)
        except BaseException as error:  # after any exception the torque would not be monitored any more
            self._is_lost = isinstance(error, SourceLost)
            self._release(f"the servos cannot be read any more: {error}")
            raise

    def temperature_c(self, joint: str) -> float | None:
        """Read the temperature of a joint's servo; None without an answer or port. For the reading thread only."""
        servo = self.servos[self.joints.index(joint)]
        bus, register = self._buses[servo.bus], servo.model.layout["temperature"]
        try:
            exchange = bus.ask(bus.read_request(servo.model, servo.id, register))
        except SourceLost:
            return None  # the next reading reports that the port is gone
        return float(exchange.answers[0].status.data[0]) if exchange.trouble is None else None

    def _read_until(self, deadline: float) -> JointReading | None:
        while True:
            if self._next_poll > deadline:
                self._wait_until(deadline)
                return None
            if self._wait_until(self._next_poll):
                self._polls += 1
                # The phase relative to the servos' ticks varies, to refine the clock offset.
                shift = self._polls * GOLDEN % 1 - (self._polls - 1) * GOLDEN % 1
                next_poll = self._next_poll + 1 / self._config.rate_hz + shift * self.vendor.tick_s
                self._next_poll = max(next_poll, self._clock.now())
                reading = self._poll()
                if reading is not None:
                    return reading
            if self._clock.now() >= deadline:
                return None

    # --- opening

    def _open_buses(self, stack: ExitStack) -> None:
        self._buses.clear()
        for name, config in self._config.buses.items():
            self._health.away.add(name)
            port, latency_s = self._open_port(config, self._clock)
            stack.callback(close_quietly, port)
            echo_free = without_echo(port, self._clock, latency_s)
            self._buses[name] = self.vendor.bus(name, echo_free, self._clock, latency_s)
            self._buses[name].counts = self._counts[name]
            self._health.away.discard(name)

    def _prepare(self) -> None:
        self._plans = plans_of(self.vendor, self._buses, self.servos, self._config)
        self._channels = [self.vendor.channel(servo) for servo in self.servos]
        self._place_of = {(servo.bus, servo.id): place for place, servo in enumerate(self.servos)}
        self._gate = SpeedGate(
            [FASTEST_RAD_S / s.model.rad_per_tick for s in self.servos], [_Settings.slack_ticks] * len(self.servos)
        )
        self._punctuality = Punctuality()
        now = self._clock.now()
        self._accepted_s, self._failures, self._next_poll, self._polls = now, 0, now, 0
        self._improve_s = now + _Settings.improve_every_s
        self._inspection = Inspection(self._buses, self.servos, self._health, self.drives, self._clock)
        self._last_error = "no answer"

    def _anchor(self) -> None:
        """Find the turn of each joint from two consistent readings."""
        agreeing = 0
        for _ in range(_Settings.anchor_polls):
            samples = self._ask_all()
            if samples is None:
                continue
            raw = [sample.ticks for sample in samples]
            if agreeing == 0:
                self._turns.begin(self.servos, raw)
            counts = self._turns.unwrapped(raw)
            agreeing = agreeing + 1 if self._gate.offer(middle(samples)[0], counts) is None else 0
            if agreeing == 2:
                self._turns.counts = counts
                self._turns.check(raw)
                self._accepted_s, self._failures = self._clock.now(), 0
                return
        raise SourceLost(f"the servos cannot be read: {self._last_error}", retry_s=HandshakeSettings.retry_s)

    def _log_opened(self) -> None:
        switched = [servo.joint for servo in self.servos if servo.had_torque]
        how = "; ".join(f"{name}: {plan.name}" for name, plan in self._plans.items())
        log.info("%d servos, torque verified off, are read (%s)", len(self.servos), how)
        for complaint in self._slow:
            log.warning("%s", complaint)
        if switched:
            log.warning("the torque of %s was on and was switched off", ", ".join(switched))

    def _restore(self) -> None:
        if not self._config.restore_torque or self._is_lost:  # a lost arm is reopened, perhaps held by hand
            return
        for servo in self.servos:
            if servo.joint in self._had_torque:
                with suppress(SourceError):
                    restore_torque(self._buses[servo.bus], servo)

    def _release(self, why: str | None) -> None:
        with ExitStack() as stack:  # release each, even if one fails
            for drive in self.drives:
                stack.callback(drive.release, why)

    # --- reading

    def _poll(self) -> JointReading | None:
        samples = self._ask_all()
        reading = None if samples is None else self._accepted(samples)
        self._inspection.inspect_next()
        self._improve()
        for why in [drive.step(reading, self.samples) for drive in self.drives]:
            if why is not None:
                self._release(why)
        if reading is None:
            self.dropped += 1
            self._failures += 1
            if self._failures >= _Settings.few_polls and self._clock.now() - self._accepted_s > LOST_AFTER_S:
                raise SourceLost(self._inspection.first_silent() or self._last_error, retry_s=HandshakeSettings.retry_s)
        else:
            self._accepted_s, self._failures = self._clock.now(), 0
        return reading

    def _improve(self) -> None:
        """Try a faster read method at intervals, but not while a drive holds joints."""
        if self._clock.now() < self._improve_s or any(drive.holding for drive in self.drives):
            return
        self._improve_s = self._clock.now() + _Settings.improve_every_s
        for name, plan in self._plans.items():
            if plan.improve():
                log.info("%s is read with %s from now on", name, plan.name)

    @property
    def _slow(self) -> list[str]:
        return [f"bus {name}: {complaint}" for name, plan in self._plans.items() for complaint in plan.complaints]

    def _ask_all(self) -> list[Sample] | None:
        """Ask all buses at the same time and return a sample of each joint; None if one is missing or doubtful."""
        samples: dict[int, Sample] = {}
        for requests in zip_longest(*(plan.requests for plan in self._plans.values())):
            requested = [(bus, q) for bus, q in zip(self._buses.values(), requests, strict=True) if q is not None]
            for bus, request in requested:
                bus.send(request)
            for bus, request in requested:
                self._collect_samples(bus, request, samples)
        return [samples[place] for place in range(len(self.joints))] if len(samples) == len(self.joints) else None

    def _collect_samples(self, bus: Bus, request: Request, samples: dict[int, Sample]) -> None:
        exchange = bus.collect(request)
        stale = False
        for answer in exchange.answers:
            place = self._place_of[bus.name, answer.status.id]
            channel = self._channels[place]
            sample = channel.take(answer)
            if sample is None:
                stale = True
                self._last_error = f"joint {self.joints[place]!r}: an answer from another time"
                if channel.rejected_in_a_row >= _Settings.rejected_in_a_row:
                    raise SourceLost(
                        f"joint {channel.servo.joint!r} (ID {channel.servo.id}) was restarted",
                        retry_s=HandshakeSettings.retry_s,
                    )
            elif exchange.trouble is None and self._is_confirmed(bus, request, channel, sample):
                samples[place] = sample
        if exchange.trouble is not None and exchange.failed_id is not None:
            servo = self.servos[self._place_of[bus.name, exchange.failed_id]]
            self._last_error = f"joint {servo.joint!r} (ID {servo.id}): {exchange.trouble}"
        elif exchange.trouble is not None:
            self._last_error = f"{bus.name}: {exchange.trouble}"
        elif stale:
            bus.settle()

    def _is_confirmed(self, bus: Bus, request: Request, channel: Channel, sample: Sample) -> bool:
        """Confirm a surprising position by asking again if the checksum lets one in 256 wrong answers through."""
        if not bus.is_weak(request) or not channel.is_unexpected:
            return True
        model = channel.servo.model
        exchange = bus.ask(bus.read_request(model, channel.servo.id, model.layout.block))
        again = channel.take(exchange.answers[0]) if exchange.trouble is None else None
        return again is not None and channel.agrees(sample, again)

    def _accepted(self, samples: list[Sample]) -> JointReading | None:
        t, uncertainty_s = middle(samples)
        if not self._punctuality.is_usual(uncertainty_s):
            self._last_error = "an answer that was held up"
            self._accepted_s = self._clock.now()  # no servo is missing
            return None
        counts = self._turns.unwrapped([sample.ticks for sample in samples])
        rejected = self._gate.offer(t, counts)
        if rejected is not None:
            servo = self.servos[rejected]
            self._last_error = f"joint {servo.joint!r} (ID {servo.id}): a position where it cannot have come to"
            if self._gate.jumped:
                raise SourceLost(self._last_error, retry_s=HandshakeSettings.retry_s)
            return None
        if t <= self._last_t:
            return None
        self._last_t = t
        return JointReading(
            t, frozen_array(self._turns.keep(counts)), uncertainty_s / math.sqrt(3)
        )  # of a uniform error

    def _wait_until(self, t: float) -> bool:
        """Wait until a time. Return False when a servo sent bytes that were not requested."""
        if t <= self._clock.now():
            return True
        bus, *_ = self._buses.values()
        return bus.listen(t)
