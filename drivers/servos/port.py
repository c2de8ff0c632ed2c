"""Interface of a serial port as a bus uses it."""

from __future__ import annotations

from typing import Protocol


class Port(Protocol):
    """An open serial port: `bodyschema.drivers.serial_line.SerialLine`, or an emulated one."""

    @property
    def baud(self) -> int:
        """Bits per second."""

    def write(self, data: bytes) -> None:
        """Send `data`. Raise BusLost when the port is gone."""

    def receive(self, until: float) -> bytes:
        """Return what has arrived, else what arrives next; empty when nothing arrives before `until` on the clock."""

    def flush(self) -> None:
        """Discard what has arrived."""

    def close(self) -> None:
        """Release the port."""
