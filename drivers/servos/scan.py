"""Scan for servos by asking each ID, then read identity and state of those that answer. Writes to no register."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace

from bodyschema.drivers.echo import BITS_PER_BYTE, HOST_S, Port, without_echo
from bodyschema.drivers.serial_line import SerialLine, SerialLineSettings
from bodyschema.drivers.servos.handshake import ask_with_retries
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.servos import FoundServo, ScannedBus

from .bus import LARGEST_RETURN_DELAY_S, Bus, Exchange, Request, Trouble
from .model import Model, Register, no_driver
from .packets import Garbled, Packets, Status
from .settings import LARGEST_ID

IDS = range(LARGEST_ID + 1)
VOLT_PER_UNIT = 0.1  # for all series of all vendors; temperatures are in °C


@dataclass(frozen=True, slots=True)
class ServoProtocol:
    """A servo vendor, or its servos with one version of its protocol."""

    name: str  # in words
    bauds: tuple[int, ...]  # rates that robot.toml can name [bit/s]
    version: int  # of the vendor's protocol
    models: Mapping[int, Model] = field(repr=False)  # by number
    errors: Mapping[int, str] = field(repr=False)  # meaning and remedy of each bit of the hardware error
    bus: type[Bus]  # class of its buses
    # names by number of models without a driver, because their control table differs
    unsupported: Mapping[int, str] = field(default_factory=dict[int, str], repr=False)

    @property
    def packets(self) -> Packets:
        return self.bus.packets_of(self.version)

    def identified(self, head: bytes, id: int) -> Identity | None:
        """Identify the servo by the start of its control table; return None if it is not of this protocol."""
        layouts = {model.layout.protocol: model.layout for model in self.models.values()}
        of_id = [layout for layout in layouts.values() if layout.value("id", head) == id]
        for layout in of_id:
            model = self.models.get(layout.value("model", head))
            if model is not None and model.layout.protocol == layout.protocol:
                return Identity(self, model, model.number, layout["firmware"].words(head))
        if not of_id:
            return None
        return Identity(self, None, of_id[0].value("model", head), of_id[0]["firmware"].words(head))


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of a servo; `model` is None when it is unknown."""

    protocol: ServoProtocol
    model: Model | None
    number: int
    firmware: str


class PingScanner:
    """Scanner for servos of protocols whose PING is identical.

    Each ID is asked. The requests do not wait for the answers, which carry an ID. If an answer is unintelligible, each
    ID is asked by itself. The start of the control table identifies the protocol.
    """

    def __init__(self, *protocols: ServoProtocol) -> None:
        self._protocols, self._packets = protocols, protocols[0].packets
        self._ping_sizes = (len(self._packets.ping(0)), self._packets.overhead + self._packets.ping_size)

    @property
    def protocol(self) -> str:
        """Names of the protocols."""
        return " and ".join(protocol.name for protocol in self._protocols)

    @property
    def bauds(self) -> Sequence[int]:
        """Baud rates that robot.toml can name for one of them, likely ones first [bit/s]."""
        return tuple(dict.fromkeys(baud for protocol in self._protocols for baud in protocol.bauds))

    def scan(self, name: str, port: Port, clock: Clock, latency_s: float) -> Iterator[FoundServo]:
        """Yield the servos on the open port `name` in the order of their IDs. Never write to a register."""
        ids = set(self._ids(port, clock, latency_s))
        if ids:  # where there is one there may be others whose answers were lost
            ids.update(self._ids(port, clock, latency_s))
        for id in sorted(ids):
            yield self._found(name, port, clock, latency_s, id)

    def _ids(self, port: Port, clock: Clock, latency_s: float) -> list[int]:
        """Return the IDs that answer. An ID with unintelligible answers counts if it answers again when asked alone."""
        port.flush()
        spacing = self._spacing_s(port.baud)
        received = b""
        for id in IDS:
            begin = clock.now()
            port.write(self._packets.ping(id))
            received += receive_until(port, clock, begin + spacing)
        received += receive_until(port, clock, clock.now() + 2 * latency_s + HOST_S)
        statuses, is_clean = self._statuses(received)
        ids = {status.id for status in statuses}
        return sorted(ids if is_clean else ids | self._ids_asked_singly(port, clock, latency_s, ids))

    def _spacing_s(self, baud: int, shortest_s: float = 1e-3) -> float:
        """Return the time between two requests [s], so that the answer to the first has ended."""
        return max(sum(self._ping_sizes) * BITS_PER_BYTE / baud + LARGEST_RETURN_DELAY_S, shortest_s)

    def _ids_asked_singly(self, port: Port, clock: Clock, latency_s: float, known: set[int]) -> set[int]:
        """Return the IDs that answer anything, asked one by one."""
        wait_s = sum(self._ping_sizes) * BITS_PER_BYTE / port.baud + LARGEST_RETURN_DELAY_S + 2 * latency_s + HOST_S
        found = set[int]()
        for id in IDS:
            if id in known:
                continue
            port.flush()
            port.write(self._packets.ping(id))
            if receive_until(port, clock, clock.now() + wait_s, self._ping_sizes[1]):
                found.add(id)
        return found

    def _statuses(self, received: bytes) -> tuple[list[Status], bool]:
        """Return the answers in the received bytes, and True if there was nothing else."""
        statuses: list[Status] = []
        at, is_clean = 0, True
        while at < len(received):
            try:
                status = self._packets.take(received, at)
            except Garbled:
                status = None
            if status is None:
                is_clean, at = False, at + 1
                continue
            statuses.append(status)
            at += status.size
        return statuses, is_clean

    def _found(self, name: str, port: Port, clock: Clock, latency_s: float, id: int) -> FoundServo:
        """Return the servo with its identity and state."""
        protocol = self._protocols[0]
        servo, bus = FoundServo(name, port.baud, self.protocol, id), protocol.bus(name, port, clock, latency_s)
        head = _read_with_retries(bus, protocol, id, self._head)
        if head.trouble is Trouble.TIMEOUT:
            hints = {protocol.packets.pinged_only: protocol.name for protocol in self._protocols}
            alone = len(hints) == 1
            return replace(
                servo, troubles=tuple(text if alone else f"if {name}: {text}" for text, name in hints.items())
            )
        if head.trouble is not None:
            return replace(servo, is_double=True, troubles=(DOUBLE,))
        identified = [
            found
            for protocol in self._protocols
            if (found := protocol.identified(head.answers[0].status.data, id)) is not None
        ]
        # The first protocol with this model, else the first possible one.
        identity = next(
            (found for found in identified if found.model is not None), identified[0] if identified else None
        )
        unsupported = protocol.unsupported.get(int.from_bytes(head.answers[0].status.data[:2], "little"))
        if unsupported is not None:
            return replace(servo, model=unsupported, troubles=(no_driver(unsupported),))
        if identity is None:
            return replace(servo, troubles=(UNKNOWN,))
        protocol, model = identity.protocol, identity.model
        servo = replace(servo, protocol=protocol.name, firmware=identity.firmware)
        if model is None:
            return replace(servo, model=f"model {identity.number}", troubles=(UNKNOWN,))
        bus = protocol.bus(name, port, clock, latency_s)
        return _with_state(bus, replace(servo, model=model.name), protocol, model)

    @property
    def _head(self) -> Register:
        """The part of the control table that identifies the servo."""
        layouts = [model.layout for protocol in self._protocols for model in protocol.models.values()]
        return Register(0, max(layout[name].end for layout in layouts for name in ("model", "firmware", "id")))


def _with_state(bus: Bus, servo: FoundServo, protocol: ServoProtocol, model: Model) -> FoundServo:
    layout = model.layout
    first, last = layout["torque"].address, layout["temperature"].end
    exchange = _read_with_retries(bus, protocol, servo.id, Register(first, last - first))
    if (
        exchange.trouble is not None
    ):  # two servos of one model give the same answers until registers that differ are read
        return replace(servo, is_double=True, troubles=(DOUBLE,))
    status = exchange.answers[0].status
    has_torque, bits = layout.torque_and_errors(status)
    troubles = [text for bit, text in protocol.errors.items() if bits & bit]
    if servo.baud not in protocol.bauds:
        troubles.append(f"robot.toml has no such rate: give it {protocol.bauds[0]:,} bit/s")
    return replace(
        servo,
        voltage_v=VOLT_PER_UNIT * layout.value("voltage", status.data, first),
        temperature_c=float(layout.value("temperature", status.data, first)),
        has_torque=bool(has_torque),
        troubles=tuple(troubles),
    )


def _read_with_retries(bus: Bus, protocol: ServoProtocol, id: int, register: Register) -> Exchange:
    request = Request(lambda n: protocol.packets.read(id, register.address, n), (id,), register.size, protocol.version)
    return ask_with_retries(bus, request)


DOUBLE = "two servos have this ID, or the cable is bad: take one off, give the other another ID"
UNKNOWN = "a model that no driver knows"


def receive_until(port: Port, clock: Clock, end: float, enough: int | None = None) -> bytes:
    """Return what arrives until `end`; with `enough` stop after this many bytes."""
    received = b""
    while clock.now() < end and (enough is None or len(received) < enough):
        received += port.receive(end)
    return received


Tell = Callable[[str], None]


def scan_port(
    port: str,
    scanners: Sequence[PingScanner],
    clock: Clock,
    tell: Tell,
    *,
    bauds: Sequence[int] = (),
    latency_s: float = SerialLineSettings.default_latency_s,
    open_port: Callable[[str, int, Clock], Port] = lambda port, baud, clock: SerialLine.open(port, baud, clock.now),
) -> ScannedBus:
    """Find the servos on a port at all rates, or at `bauds`.

    Args:
        scanners: one per protocol.
        tell: called with each step and each finding.
        bauds: rates to try; all by default.
        latency_s: longest time that the adapter holds bytes back.
    """
    found: list[FoundServo] = []
    all_bauds = dict.fromkeys(baud for scanner in scanners for baud in scanner.bauds)
    try:
        for baud in bauds or all_bauds:
            with closing(open_port(port, baud, clock)) as opened:
                line = without_echo(opened, clock, latency_s)
                for scanner in scanners:
                    if baud in scanner.bauds:
                        count = f"{len(found)} servo{'' if len(found) == 1 else 's'}"
                        tell(f"{port}: {scanner.protocol} at {baud:,} bit/s; {count} so far")
                        found += scanner.scan(port, line, clock, latency_s)
    except SourceError as error:
        return ScannedBus(port, tuple(found), str(error))
    return ScannedBus(port, tuple(found))
