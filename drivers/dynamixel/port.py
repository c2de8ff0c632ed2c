"""A hardened dynamixel-sdk port: exclusive, on a monotonic clock, without spinning, lost with a clear error."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

import dynamixel_sdk as sdk

from bodyschema.drivers.serial_line import SerialLine
from bodyschema.drivers.servos.port import Port

__all__ = ["Port", "SafePort"]

TIMEOUT_MARGIN_S = 2e-3


class SafePort(sdk.PortHandler):
    """An open port, for the driver and for any part of dynamixel-sdk that takes a PortHandler."""

    def __init__(self, port: str, baud: int, *, latency_s: float, now: Callable[[], float] = time.monotonic) -> None:
        """Prepare without opening it. `openPort` raises SourceError where the original returns False.

        Args:
            port: path of the port.
            baud: bits per second.
            latency_s: longest time that the adapter holds bytes back.
            now: the clock [s].
        """
        super().__init__(port)
        self.baudrate = baud
        self._latency_s, self._now = latency_s, now
        self._line: SerialLine | None = None

    @property
    def baud(self) -> int:
        """Bits per second."""
        return self.baudrate

    @property
    def line(self) -> SerialLine:
        """The open port. Raises ConnectionError when it is not open."""
        if self._line is None:
            raise ConnectionError(f"{self.port_name} is not open")
        return self._line

    def setupPort(self, cflag_baud: int) -> Literal[True]:
        """Open the port exclusively at the given rate."""
        if self.is_open:
            self.closePort()
        self._line = SerialLine.open(self.port_name, cflag_baud, self._now)
        self.ser = self._line.device
        self.is_open, self.is_using = True, False
        self.tx_time_per_byte = 10_000.0 / cflag_baud
        self._line.flush()
        return True

    def closePort(self) -> None:
        """Release the port."""
        self.is_open = self.is_using = False
        if self._line is not None:
            self._line.close()
            self._line = None

    def clearPort(self) -> None:
        """Discard what has arrived."""
        self.line.flush()

    def readPort(self, length: int) -> bytes:
        """Return up to `length` bytes. Wait a moment for the first."""
        return self.line.device.read(length) if self.line.wait(self._now() + TIMEOUT_MARGIN_S) else b""

    def writePort(self, packet: bytes | list[int]) -> int:
        """Send all of it."""
        self.line.write(bytes(packet))
        return len(packet)

    def getCurrentTime(self) -> float:
        """Return the monotonic time [ms]."""
        return self._now() * 1e3

    def setPacketTimeout(self, packet_length: int) -> None:
        """Set the time-out of an answer of `packet_length` bytes, from this adapter's latency."""
        self.packet_start_time = self.getCurrentTime()
        waiting_s = 2 * self._latency_s + TIMEOUT_MARGIN_S
        self.packet_timeout = self.tx_time_per_byte * packet_length + waiting_s * 1e3

    def write(self, data: bytes) -> None:
        """Send `data`."""
        self.line.write(data)

    def flush(self) -> None:
        """Discard what has arrived."""
        self.line.flush()

    def close(self) -> None:
        """Release the port."""
        self.closePort()

    def receive(self, until: float) -> bytes:
        """Return what has arrived, else what arrives next; empty when nothing arrives before `until`."""
        return self.line.receive(until)
