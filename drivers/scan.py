"""Scan the serial ports of this machine for servos, in every protocol at every rate, without writing a register."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Protocol

from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.servos import FoundServo, ScannedBus

from .echo import without_echo
from .serial_line import DEFAULT_LATENCY_S, SerialLine

BY_ID = "dev/serial/by-id"
ADAPTERS = ("ttyUSB*", "ttyACM*")


class ScannedPort(Protocol):
    """A serial port as a scanner uses it."""

    @property
    def baud(self) -> int:
        """Bits per second."""

    def write(self, data: bytes) -> None:
        """Send `data`."""

    def receive(self, until: float) -> bytes:
        """Return what has arrived, else what arrives next; empty when nothing arrives before `until` on the clock."""

    def flush(self) -> None:
        """Discard what has arrived."""

    def close(self) -> None:
        """Release the port."""


class Scanner(Protocol):
    """Scanner for the servos that speak one protocol."""

    @property
    def protocol(self) -> str:
        """Name of the protocol."""

    @property
    def bauds(self) -> Sequence[int]:
        """Possible baud rates, likely ones first [bit/s]."""

    def scan(self, name: str, port: ScannedPort, clock: Clock, latency_s: float) -> Iterator[FoundServo]:
        """Yield the servos on the open port `name` in the order of their IDs. Never write to a register."""


OpenPort = Callable[[str, int, Clock], ScannedPort]
Tell = Callable[[str], None]


def serial_ports(root: Path = Path("/")) -> list[str]:
    """Return the USB serial ports of this machine, by their persistent names where there are any."""
    by_id = sorted((root / BY_ID).glob("*"))
    named = {link.resolve() for link in by_id}
    others = [port for pattern in ADAPTERS for port in sorted((root / "dev").glob(pattern))]
    return [str(port) for port in (*by_id, *(port for port in others if port.resolve() not in named))]


def open_line(port: str, baud: int, clock: Clock) -> ScannedPort:
    """Open a real port."""
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
    """Find the servos on a port at all rates, or at `bauds`.

    Args:
        port: to be scanned.
        scanners: one per protocol.
        clock: the clock.
        tell: called with each step and with what was found.
        bauds: rates to try; all by default.
        latency_s: longest time that the adapter holds bytes back.
        open_port: opens the port.
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
