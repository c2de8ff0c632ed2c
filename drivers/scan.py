"""Who is on the serial ports of this machine? Asked in every protocol at every rate; nothing is written to anybody."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock

from .echo import without_echo
from .serial_line import DEFAULT_LATENCY_S, SerialLine

BY_ID = "dev/serial/by-id"
ADAPTERS = ("ttyUSB*", "ttyACM*")


class ScannedPort(Protocol):
    """What a scanner needs of a serial port."""

    @property
    def baud(self) -> int:
        """Bits per second."""
        ...

    def write(self, data: bytes) -> None:
        """Send `data`."""
        ...

    def receive(self, until: float) -> bytes:
        """What has arrived, else what arrives next; nothing when that is not before `until` on the clock."""
        ...

    def flush(self) -> None:
        """Forget what has arrived."""
        ...

    def close(self) -> None:
        """Give it free."""
        ...


@dataclass(frozen=True, slots=True)
class FoundServo:
    """A servo that answered.

    Attributes:
        protocol: in words, as "Dynamixel 2.0".
        firmware: its version, as its maker writes it.
        model: by name, or its number where it is not known; None when it does not tell.
        voltage_v, temperature_c: as it says itself; None when it does not tell.
        has_torque: its motor holds its place; None when it does not tell.
        troubles: what is wrong with it, and what to do.
        is_double: several servos answer to this ID.
    """

    port: str
    baud: int
    protocol: str
    id: int
    model: str | None = None
    firmware: str | None = None
    voltage_v: float | None = None
    temperature_c: float | None = None
    has_torque: bool | None = None
    troubles: tuple[str, ...] = ()
    is_double: bool = False


class Scanner(Protocol):
    """Finds the servos that speak one protocol."""

    @property
    def protocol(self) -> str:
        """Its name."""
        ...

    @property
    def bauds(self) -> Sequence[int]:
        """Rates at which such servos can be, the likely ones first [bit/s]."""
        ...

    def scan(self, name: str, port: ScannedPort, clock: Clock, latency_s: float) -> Iterator[FoundServo]:
        """The servos on an open port that is called `name`, in the order of their IDs. Never writes to a register."""
        ...


OpenPort = Callable[[str, int, Clock], ScannedPort]
Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ScannedBus:
    """What came of one port.

    Attributes:
        servos: who answered.
        trouble: why it could not be scanned (through), or None.
    """

    port: str
    servos: tuple[FoundServo, ...]
    trouble: str | None = None


def serial_ports(root: Path = Path("/")) -> list[str]:
    """The USB serial ports of this machine, by the names that stay the same where there are such."""
    by_id = sorted((root / BY_ID).glob("*"))
    named = {link.resolve() for link in by_id}
    others = [port for pattern in ADAPTERS for port in sorted((root / "dev").glob(pattern))]
    return [str(port) for port in (*by_id, *(port for port in others if port.resolve() not in named))]


def open_line(port: str, baud: int, clock: Clock) -> ScannedPort:
    """A real port, open."""
    return SerialLine.open(port, baud, clock.now)


def scan_port(
    port: str,
    scanners: Iterable[Scanner],
    clock: Clock,
    tell: Tell,
    *,
    bauds: Sequence[int] = (),
    latency_s: float = DEFAULT_LATENCY_S,
    open_port: OpenPort = open_line,
) -> ScannedBus:
    """Ask at all rates, or at `bauds`, who is there.

    Args:
        tell: called with what is done next, and what was found.
        latency_s: how long the adapter may keep bytes back.
    """
    found: list[FoundServo] = []
    scanners = list(scanners)
    all_bauds = dict.fromkeys(baud for scanner in scanners for baud in scanner.bauds)
    try:
        for baud in bauds or all_bauds:
            with closing(open_port(port, baud, clock)) as opened:
                line = without_echo(opened, clock, latency_s)
                for scanner in scanners:
                    if baud in scanner.bauds:
                        tell(f"{port}: {scanner.protocol} at {baud:,} bit/s; {_counted(found)} so far")
                        found += scanner.scan(port, line, clock, latency_s)
    except SourceError as error:
        return ScannedBus(port, tuple(found), str(error))
    return ScannedBus(port, tuple(found))


def _counted(found: Sequence[FoundServo]) -> str:
    return f"{len(found)} servo{'' if len(found) == 1 else 's'}"
