"""Exclusive serial port that blocks without spinning and reports its loss."""

from __future__ import annotations

import errno
import os
import select
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import serial

from bodyschema.interfaces.errors import SourceError, SourceLost


class SerialLineSettings:
    retry_s: float = 0.2  # period of looking for a lost port
    default_latency_s: float = 4e-3  # for adapters that do not report their latency


LATENCY_OF = "/sys/bus/usb-serial/devices/{}/latency_timer"


def serial_ports(root: Path = Path("/")) -> list[str]:
    """Return the USB serial ports of this machine, by their persistent names where there are any."""
    by_id = sorted((root / "dev/serial/by-id").glob("*"))
    named = {link.resolve() for link in by_id}
    others = [port for pattern in ("ttyUSB*", "ttyACM*") for port in sorted((root / "dev").glob(pattern))]
    return [str(port) for port in (*by_id, *(port for port in others if port.resolve() not in named))]


class BusLost(SourceLost):
    """The port, or the device behind it, was lost or is not present yet."""

    def __init__(self, port: str, error: Exception, state: str = "is gone") -> None:
        number = next((part for part in error.args if isinstance(part, int)), None)
        why = os.strerror(number) if number else str(error) or "it was unplugged"
        super().__init__(f"{port} {state}: {why}", retry_s=SerialLineSettings.retry_s)


def adapter_latency_s(port: str, latency_of: str = LATENCY_OF) -> float:
    """Return how long the USB adapter of `port` may hold bytes back [s]."""
    file = Path(latency_of.format(Path(port).resolve().name))
    try:
        return int(file.read_text()) * 1e-3
    except (OSError, ValueError):
        return SerialLineSettings.default_latency_s


class SerialLine:
    """An open serial port."""

    def __init__(self, device: serial.Serial, now: Callable[[], float]) -> None:
        """Wrap an open device; see `open`."""
        self.device = device
        self._now = now

    @classmethod
    def open(cls, port: str, baud: int, now: Callable[[], float] = time.monotonic) -> SerialLine:
        """Open `port` exclusively.

        Raises:
            BusLost: there is no such port (any more).
            SourceError: it is in use, or this user may not open it.
        """
        try:
            device = serial.Serial(port, baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise _refused(port, baud, error) from error
        with suppress(OSError, ValueError):  # not supported by every adapter; without it, those of FTDI wait 16 ms
            device.set_low_latency_mode(True)
        return cls(device, now)

    @property
    def baud(self) -> int:
        return self.device.baudrate

    def close(self) -> None:
        """Release the port. Closing it again does no harm."""
        try:
            self.device.close()
        except (OSError, termios.error) as error:
            raise BusLost(str(self.device.port), error) from error

    def write(self, data: bytes) -> None:
        try:
            self.device.write(data)
        except (OSError, termios.error) as error:
            raise BusLost(str(self.device.port), error) from error

    def receive(self, until: float) -> bytes:
        if not self.wait(until):
            return b""
        try:
            data = os.read(self.device.fileno(), 4096)
        except OSError as error:
            raise BusLost(str(self.device.port), error) from error
        if not data:
            raise BusLost(str(self.device.port), OSError(errno.ENODEV, "unplugged"))
        return data

    def wait(self, until: float) -> bool:
        """Return True if there is something to receive before `until`."""
        try:
            readable, _, _ = select.select((self.device.fileno(),), (), (), max(0.0, until - self._now()))
        except (OSError, ValueError) as error:
            raise BusLost(str(self.device.port), error) from error
        return bool(readable)

    def flush(self) -> None:
        try:
            self.device.reset_input_buffer()
        except (OSError, termios.error) as error:  # an unplugged port raises termios.error, which is not an OSError
            raise BusLost(str(self.device.port), error) from error


def _refused(port: str, baud: int, error: Exception) -> SourceError:
    number = getattr(error, "errno", None)
    if number == errno.EACCES:
        return SourceError(
            f"{port} may not be opened by this user. Type: sudo usermod -aG dialout $USER, and log in again"
        )
    if number in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in str(error):
        return SourceError(f"{port} is in use by another program. End that one (fuser {port} shows it)")
    if isinstance(error, ValueError):
        return SourceError(f"{port} cannot be opened at {baud} bit/s: {error}")
    return BusLost(port, error, "is not there" if number == errno.ENOENT else "cannot be opened")
