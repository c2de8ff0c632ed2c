"""What a bus needs of a serial port."""

from __future__ import annotations

from typing import Protocol


class Port(Protocol):
    """An open serial port; `bodyschema.drivers.serial_line.SerialLine`, or a bench's."""

    @property
    def baud(self) -> int:
        """Bits per second."""
        ...

    def write(self, data: bytes) -> None:
        """Send `data`; BusLost when the port is gone."""
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
