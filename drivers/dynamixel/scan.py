"""Finds Dynamixel servos of both protocols at whatever rate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from drivers.scan import FoundServo, ScannedPort
from drivers.servos.bus import BITS_PER_BYTE, SLOWEST_DELAY_S
from interfaces.protocols import Clock

from .bus import Bus, Exchange, Trouble, read_request
from .models import BY_NUMBER, HARDWARE_ERRORS, LAYOUT_X, Model
from .packets import BROADCAST, Garbled, Status, Version, packets_of

LIKELY_FIRST = (1_000_000, 57_600, 2_000_000, 115_200, 3_000_000, 4_000_000, 9_600)
FASTEST1 = 3_000_000  # of Protocol 1.0
IDS = range(253)
SLOT_S = 3e-3  # each servo of Protocol 2.0 waits so long for each ID before its own
HOST_S = 5e-3  # the operating system's part of an answer's delay
APART_S = 1e-3  # between two questions at least
ATTEMPTS = 3
PING_SIZES: dict[Version, tuple[int, int]] = {1: (6, 6), 2: (10, 14)}  # bytes of question and answer
VOLT_PER_UNIT = 0.1


class DynamixelScanner:
    """Finds servos of one protocol: `Scanner`.

    Of Protocol 2.0 one question asks for all; when something comes that cannot be understood, each ID is asked by
    itself. In Protocol 1.0 each is asked anyway. The questions do not wait for the answers, which carry an ID.
    """

    def __init__(self, version: Version) -> None:
        self._version: Version = version
        self._packets = packets_of(version)

    @property
    def protocol(self) -> str:
        """Its name."""
        return f"Dynamixel {self._version}.0"

    @property
    def bauds(self) -> Sequence[int]:
        """Rates that robot.toml can name, the likely ones first [bit/s]."""
        return tuple(baud for baud in LIKELY_FIRST if self._version == 2 or baud <= FASTEST1)

    def scan(self, name: str, port: ScannedPort, clock: Clock, latency_s: float) -> Iterator[FoundServo]:
        """The servos on the port; see `Scanner.scan`."""
        bus = Bus(name, port, clock, latency_s)
        for id in self._ids(port, clock, latency_s):
            yield self._found(bus, FoundServo(name, port.baud, self.protocol, id))

    def _ids(self, port: ScannedPort, clock: Clock, latency_s: float) -> list[int]:
        if self._version == 1:
            return self._pinged(port, clock, latency_s)
        port.flush()
        port.write(self._packets.ping(BROADCAST))
        byte_s = BITS_PER_BYTE / port.baud
        end = clock.now() + len(IDS) * SLOT_S + 2 * latency_s + HOST_S + sum(PING_SIZES[2]) * byte_s
        heard = _heard(port, clock, end)
        statuses, is_clean = self._statuses(heard)
        return sorted({status.id for status in statuses}) if is_clean else self._pinged(port, clock, latency_s)

    def _pinged(self, port: ScannedPort, clock: Clock, latency_s: float) -> list[int]:
        """Who answers when each is asked. An ID whose answers are not understood counts when it is asked again."""
        port.flush()
        asked, answered = PING_SIZES[self._version]
        spacing = max((asked + answered) * BITS_PER_BYTE / port.baud + SLOWEST_DELAY_S, APART_S)
        heard = b""
        for id in IDS:
            begin = clock.now()
            port.write(self._packets.ping(id))
            heard += _heard(port, clock, begin + spacing)
        heard += _heard(port, clock, clock.now() + 2 * latency_s + HOST_S)
        statuses, is_clean = self._statuses(heard)
        ids = {status.id for status in statuses}
        return sorted(ids if is_clean else ids | self._unclear(port, clock, latency_s, ids))

    def _unclear(self, port: ScannedPort, clock: Clock, latency_s: float, known: set[int]) -> set[int]:
        """Who answers something, asked one after the other."""
        _, answered = PING_SIZES[self._version]
        found = set[int]()
        for id in IDS:
            if id in known:
                continue
            port.flush()
            port.write(self._packets.ping(id))
            wire_s = sum(PING_SIZES[self._version]) * BITS_PER_BYTE / port.baud
            heard = _heard(port, clock, clock.now() + wire_s + SLOWEST_DELAY_S + 2 * latency_s + HOST_S, answered)
            if heard:
                found.add(id)
        return found

    def _statuses(self, heard: bytes) -> tuple[list[Status], bool]:
        """The answers in what was heard, and whether there was nothing else."""
        statuses: list[Status] = []
        at, is_clean = 0, True
        while at < len(heard):
            try:
                status = self._packets.take(heard, at)
            except Garbled:
                status = None
            if status is None:
                is_clean, at = False, at + 1
                continue
            statuses.append(status)
            at += status.size
        return statuses, is_clean

    def _found(self, bus: Bus, servo: FoundServo) -> FoundServo:
        """The servo with what it tells of itself."""
        head = self._read(bus, servo.id, 0, LAYOUT_X["firmware"].end if self._version == 2 else 3)
        if head.trouble is Trouble.TIMEOUT:
            return replace(servo, troubles=(_mute(self._version),))
        if head.trouble is not None:
            return replace(servo, is_double=True, troubles=(_DOUBLE,))
        data = head.answers[0].status.data
        number, firmware = int.from_bytes(data[:2], "little"), data[-1]
        model = BY_NUMBER.get(number)
        if model is None or model.protocol != self._version:
            return replace(servo, model=f"model {number}", firmware=firmware, troubles=(_UNKNOWN,))
        return self._with_state(bus, replace(servo, model=model.name, firmware=firmware), model)

    def _with_state(self, bus: Bus, servo: FoundServo, model: Model) -> FoundServo:
        layout = model.layout
        first, last = layout["torque"].address, layout["temperature"].end
        told = self._read(bus, servo.id, first, last - first)
        if told.trouble is not None:  # two of one model say the same until they are asked for what differs
            return replace(servo, is_double=True, troubles=(_DOUBLE,))
        status = told.answers[0].status

        def value(name: str) -> int:
            register = layout[name]
            return register.value(status.data[register.address - first : register.end - first])

        bits = status.error if self._version == 1 else value("hardware_error")
        return replace(
            servo,
            voltage_v=VOLT_PER_UNIT * value("voltage"),
            temperature_c=float(value("temperature")),
            has_torque=bool(value("torque")),
            troubles=tuple(text for bit, text in HARDWARE_ERRORS.items() if bits & bit),
        )

    def _read(self, bus: Bus, id: int, address: int, size: int) -> Exchange:
        exchange = Exchange(())
        for _ in range(ATTEMPTS):
            exchange = bus.ask(read_request(self._version, id, address, size))
            if exchange.trouble is None:
                break
        return exchange


_DOUBLE = "two servos have this ID, or the cable is bad: take one off, give the other another ID"
_UNKNOWN = "a model that this driver does not know"


def _mute(version: Version) -> str:
    register = 68 if version == 2 else 16
    return f"answers PING but no READ: set its Status Return Level ({register}) to 2"


def _heard(port: ScannedPort, clock: Clock, end: float, enough: int | None = None) -> bytes:
    """What comes until `end`; with `enough` only until there are so many bytes."""
    heard = b""
    while clock.now() < end and (enough is None or len(heard) < enough):
        heard += port.receive(end)
    return heard


SCANNERS = (DynamixelScanner(2), DynamixelScanner(1))
