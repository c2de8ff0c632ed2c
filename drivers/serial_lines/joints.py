"""Custom encoders as a `JointSource`."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Self

from bodyschema.drivers.checks import Check, CheckSettings, aligned, warned
from bodyschema.drivers.echo import BITS_PER_BYTE, Port, close_quietly
from bodyschema.drivers.serial_line import SerialLine, SerialLineSettings
from bodyschema.drivers.speed_gate import FASTEST_RAD_S, SpeedGate
from bodyschema.drivers.turn_count import LOST_AFTER_S, TurnCount
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import JointReading, frozen_array

from .board import Board, Counts, Timed
from .config import EncoderConfig, SerialLinesConfig
from .lines import ASK_HEADER, Header

log = logging.getLogger(__name__)


class _Settings:
    # an Arduino restarts when its port is opened, which takes two seconds
    header_s: float = 4.0
    anchor_s: float = 2.0
    few_attempts: int = 3
    # of a turn
    slack_ticks_part: int = 1000
    few_per_s: float = 50.0
    ask_every_s: float = 0.5  # for the board's header
    largest_sigma_s: float = 5e-3  # of a reading's time


OpenPort = Callable[[SerialLinesConfig, Clock], Port]


def open_serial(config: SerialLinesConfig, clock: Clock) -> Port:
    return SerialLine.open(config.port, config.baud, clock.now)


@dataclass(frozen=True, slots=True)
class Encoder:
    """An encoder as announced by the board."""

    config: EncoderConfig  # its entry in robot.toml
    place: int  # its place in the board's lines
    ticks_per_turn: int  # ticks after which the reading repeats

    @property
    def joint(self) -> str:
        return self.config.joint

    @property
    def label(self) -> str:
        return f"encoder {self.config.name!r}"

    @property
    def rad_per_tick(self) -> float:
        """Angle per tick [rad]."""
        return 2 * math.pi / self.ticks_per_turn

    def angle(self, ticks: int) -> float:
        return self.config.direction * (ticks - self.config.zero_ticks) * self.rad_per_tick

    def ticks(self, angle: float) -> float:
        return self.config.zero_ticks + self.config.direction * angle / self.rad_per_tick


class SerialLineJoints:
    """Reader of the encoders of a board that sends a line per measurement.

    A reading is an intact line in sequence, with a time confirmed by the board's clock, and with plausible positions of
    all joints. SourceLost is raised when there is none for a quarter of a second, or when the board was restarted. When
    it is opened again, all positions are compared with the last ones.

    Attributes:
        joints: names of the joints in the order of q.
        encoders: as found at the last opening, in the order of the joints.
        epoch: how often it was opened.
        dropped: readings that were dropped although their lines were intact.
    """

    def __init__(
        self,
        config: SerialLinesConfig,  # checked; see `SerialLinesConfig.check`
        joints: Sequence[str],
        clock: Clock,
        *,
        # of each joint [rad]; a range below one turn determines the turn
        limits: Sequence[tuple[float, float]] | None = None,
        last_pose: Sequence[float] | None = None,  # last joint angles [rad], shape (d,), from which turns are counted
        open_port: OpenPort = open_serial,
    ) -> None:
        self._config, self.joints, self._clock, self._open_port = config, tuple(joints), clock, open_port
        by_joint = {encoder.joint: encoder for encoder in config.encoders}
        self._configured = [by_joint[joint] for joint in joints]
        unlimited = [(-math.inf, math.inf)] * len(joints)
        self._turns = TurnCount(limits or unlimited, last_pose)
        self._port: Port | None = None
        self._board = Board(0.0, 0.0)
        self._last_t = self._accepted_s = self._heard_s = -math.inf
        self._attempts = 0
        self._last_error, self._failing = "", set[str]()
        self.encoders: list[Encoder] = []
        self.epoch = self.dropped = 0

    @property
    def counts(self) -> Counts:
        """Number of lines by outcome since the last opening."""
        return self._board.counts

    @property
    def health(self) -> tuple[str, ...]:
        """Failing encoders, and what to do."""
        return tuple(_complaint(joint) for joint in sorted(self._failing))

    @property
    def record(self) -> tuple[Mapping[str, object], ...]:
        """Identity and settings of each encoder, to be stored with the data."""
        return tuple(
            {
                "joint": encoder.joint,
                "encoder": encoder.config.name,
                "ticks_per_turn": encoder.ticks_per_turn,
                "zero_ticks": encoder.config.zero_ticks,
                "direction": encoder.config.direction,
                "rad_per_tick": encoder.rad_per_tick,
            }
            for encoder in self.encoders
        )

    @property
    def asks_for_turns(self) -> bool:
        """True if it cannot be opened because a joint lost its turn count."""
        return self._turns.lost is not None

    def accept_turns(self) -> None:
        """Accept the turns nearest to the last pose at the next opening. May be called from any thread."""
        self._turns.accept()

    def __enter__(self) -> Self:
        port = self._open_port(self._config, self._clock)
        with ExitStack() as stack:
            stack.callback(close_quietly, port)
            self._begin(port)
            stack.pop_all()
        self._port = port
        self.epoch += 1
        log.info("%d encoders are read", len(self.encoders))
        return self

    def __exit__(self, *_: object) -> None:
        if self._port is not None:
            close_quietly(self._port)
            self._port = None

    def read(self, timeout_s: float) -> JointReading | None:
        """Return the next reading; see `JointSource.read`.

        Raises:
            SourceLost: the port is gone, no intact lines arrive, or the board was restarted.
        """
        if self._port is None:
            raise SourceError("the encoders are not open; use them in a with statement")
        deadline = self._clock.now() + timeout_s
        while True:
            while (timed := self._board.next()) is not None:
                reading = self._accepted(timed)
                if reading is not None:
                    self._accepted_s, self._attempts = self._clock.now(), 0
                    return reading
                self.dropped += 1
            self._hear(self._port, deadline)
            if self._clock.now() >= deadline:
                return None

    # --- opening

    def _begin(self, port: Port) -> None:
        port.flush()
        byte_s = 0.0 if self._config.native_usb else BITS_PER_BYTE / port.baud
        self._board = Board(byte_s, self._config.delay_ms * 1e-3)
        self.encoders = self._found(self._introduced(port))
        self._failing.clear()
        self._gate = SpeedGate(
            [FASTEST_RAD_S / encoder.rad_per_tick for encoder in self.encoders],
            [2 + encoder.ticks_per_turn / _Settings.slack_ticks_part for encoder in self.encoders],
        )
        self._anchor(port)
        self._accepted_s = self._heard_s = self._clock.now()
        self._attempts = 0

    def _introduced(self, port: Port) -> Header:
        """Return the board's header. Request it until it arrives."""
        end, heard = self._clock.now() + _Settings.header_s, 0
        while self._clock.now() < end:
            port.write(ASK_HEADER)
            ask_again = min(end, self._clock.now() + _Settings.ask_every_s)
            while self._clock.now() < ask_again:
                data = port.receive(ask_again)
                heard += len(data)
                self._board.hear(data, self._clock.now())
                if self._board.header is not None:
                    return self._board.header
        what = "sends nothing: does its program run?" if heard == 0 else "sends no header: compare baud, and the lines"
        raise SourceLost(f"the board on {self._config.port} {what}", retry_s=SerialLineSettings.retry_s)

    def _found(self, header: Header) -> list[Encoder]:
        """Return the encoders; raise SourceError with a table of all if one differs from robot.toml."""
        rows, encoders = [("joint", "encoder", "expected", "found")], list[Encoder]()
        places = list(header.encoders)
        for config in self._configured:
            announced, expected = header.encoders.get(config.name), config.ticks_per_turn
            rows.append((config.joint, config.name, _ticks(expected, "any"), _ticks(announced, "not announced")))
            if announced is not None and expected in (None, announced):
                encoders.append(Encoder(config, places.index(config.name), announced))
        if len(encoders) == len(self._configured):
            return encoders
        what = f"the encoders on {self._config.port} are not those of robot.toml:"
        raise SourceError("\n  ".join([what, *aligned(rows), f"announced are: {', '.join(places)}"]))

    def _anchor(self, port: Port) -> None:
        """Find the turn of each joint from two consistent readings; wait until the times are accurate."""
        end, agreeing = self._clock.now() + _Settings.anchor_s, 0
        self._last_error = "no line"
        while self._clock.now() < end:
            while (timed := self._board.next()) is not None:
                raw = self._raw(timed)
                if raw is None:
                    continue
                if agreeing == 0:
                    self._turns.begin(self.encoders, raw)
                counts = self._turns.unwrapped(raw)
                agreeing = agreeing + 1 if self._gate.offer(timed.t, counts) is None else 0
                if agreeing >= 2:
                    self._turns.counts = counts
                if agreeing == 2:
                    self._turns.check(raw)
                if agreeing >= 2 and self._has_accurate_time(timed):
                    return
            self._board.hear(port.receive(end), self._clock.now())
        raise SourceLost(f"the encoders cannot be read: {self._last_error}", retry_s=SerialLineSettings.retry_s)

    # --- reading

    def _hear(self, port: Port, deadline: float) -> None:
        lost_at = self._accepted_s + LOST_AFTER_S
        data = port.receive(min(deadline, max(lost_at, self._clock.now() + LOST_AFTER_S / _Settings.few_attempts)))
        garbled = self.counts.garbled
        self._board.hear(data, self._clock.now())
        if self._board.restarted:
            raise SourceLost("the board was restarted, or its lines were held up", retry_s=SerialLineSettings.retry_s)
        if data:
            self._heard_s = self._clock.now()
        if self.counts.garbled > garbled:
            self._last_error = "a garbled line"
        elif self._clock.now() - self._heard_s > LOST_AFTER_S:
            self._last_error = "no line"
        self._attempts += 1
        if self._clock.now() > lost_at and self._attempts >= _Settings.few_attempts and not self._board.is_waiting:
            raise SourceLost(f"the encoders cannot be read: {self._last_error}", retry_s=SerialLineSettings.retry_s)

    def _raw(self, timed: Timed) -> list[int] | None:
        """Return the raw positions of the joints; None if an encoder has no value."""
        ticks = [timed.reading.ticks[encoder.place] for encoder in self.encoders]
        self._note_failing({e.joint for e, tick in zip(self.encoders, ticks, strict=True) if tick is None})
        raw = [tick for tick in ticks if tick is not None]
        return raw if len(raw) == len(ticks) else None

    def _accepted(self, timed: Timed) -> JointReading | None:
        raw = self._raw(timed)
        if raw is None:
            return None
        if not self._has_accurate_time(timed):
            self._accepted_s = self._clock.now()  # no encoder is missing
            return None
        counts = self._turns.unwrapped(raw)
        rejected = self._gate.offer(timed.t, counts)
        if rejected is not None:
            self._last_error = f"joint {self.joints[rejected]!r}: a position where it cannot have come to"
            if self._gate.jumped:
                raise SourceLost(self._last_error, retry_s=SerialLineSettings.retry_s)
            return None
        if timed.t <= self._last_t:
            return None
        self._last_t = timed.t
        return JointReading(timed.t, frozen_array(self._turns.keep(counts)), timed.sigma)

    def _has_accurate_time(self, timed: Timed) -> bool:
        """Return True if the time of the reading is accurate enough."""
        if timed.sigma > _Settings.largest_sigma_s:
            self._last_error = "delayed lines, whose time is unknown"
            return False
        return True

    def _note_failing(self, joints: set[str]) -> None:
        for joint in sorted(joints - self._failing):
            log.warning("%s", _complaint(joint))
        for joint in sorted(self._failing - joints):
            log.info("the encoder of joint %r is well again", joint)
        self._failing = joints
        if joints:
            self._last_error = _complaint(min(joints))


def _ticks(count: int | None, otherwise: str) -> str:
    return otherwise if count is None else f"{count} ticks"


def _complaint(joint: str) -> str:
    return f"joint {joint!r}: its encoder has no value: look at its cable, and at the magnet's distance"


def encoder_checks(config: SerialLinesConfig, joints: Sequence[str], clock: Clock) -> Iterator[Check]:
    """Yield checks of the configured encoders and of their reading rate. Open the port for that."""
    try:
        with SerialLineJoints(config, joints, clock) as encoders:
            yield Check("encoders", "ok", f"all {len(joints)} of robot.toml are in the board's header")
            end, readings = clock.now() + CheckSettings.read_s, 0
            while clock.now() < end:
                readings += encoders.read(end - clock.now()) is not None
            rate_hz, counts = readings / CheckSettings.read_s, encoders.counts
            fix = "a higher rate of the UART, fewer other things that the board does"
            yield warned("rate", f"{rate_hz:.0f} readings/s come", fix, when=rate_hz < _Settings.few_per_s)
            lost = counts.garbled + counts.missing
            message = f"{lost} of {counts.lines + lost} lines were garbled or missing"
            fix = "look at the cable, and whether the board keeps the rate exactly"
            yield warned("errors", message, fix, when=lost > CheckSettings.many_troubles * (counts.lines + lost))
            for complaint in encoders.health:
                message, _, fix = complaint.rpartition(": ")
                yield Check("encoders", "wrong", message, fix)
    except SourceError as error:
        yield Check("encoders", "wrong", str(error))
