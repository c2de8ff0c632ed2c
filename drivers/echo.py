"""Handle adapters that echo what is sent, such as those that tie both lines of a half-duplex bus together."""

from __future__ import annotations

import logging
from contextlib import suppress
from typing import Protocol

from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock

log = logging.getLogger(__name__)

PROBE = b"\x00"  # not the start of any packet
BITS_PER_BYTE = 10  # including start and stop bit
HOST_S = 3e-3  # the operating system's share of the delay


class Port(Protocol):
    """An open serial port: `bodyschema.drivers.serial_line.SerialLine`, or an emulated one."""

    @property
    def baud(self) -> int:
        """Bits per second."""
        ...

    def write(self, data: bytes) -> None:
        """Send `data`; raise BusLost if the port is gone."""

    def receive(self, until: float) -> bytes:
        """Return received bytes, or wait for the next; empty if nothing arrives before `until` on the clock."""
        ...

    def flush(self) -> None:
        """Discard what has arrived."""

    def close(self) -> None:
        """Release the port."""


def close_quietly(port: Port) -> None:
    """Close a port, ignoring errors."""
    with suppress(SourceError):
        port.close()


def without_echo(port: Port, clock: Clock, latency_s: float) -> Port:
    """Return `port`, wrapped to remove its adapter's echo if there is one. Send a byte to find out.

    Args:
        latency_s: longest time that the adapter holds bytes back.
    """
    port.flush()
    port.write(PROBE)
    if port.receive(clock.now() + BITS_PER_BYTE / port.baud + 2 * latency_s + HOST_S) != PROBE:
        return port
    log.info("the adapter sends back what is sent; this is taken out of what is received")
    return EchoFree(port, clock)


class EchoFree:
    """A port whose adapter echoes what is sent."""

    def __init__(self, port: Port, clock: Clock) -> None:
        self._port, self._clock = port, clock
        self._own = bytearray()

    @property
    def baud(self) -> int:
        return self._port.baud

    def write(self, data: bytes) -> None:
        self._own += data
        self._port.write(data)

    def receive(self, until: float) -> bytes:
        """Return received bytes without the echo, or wait for the next; empty if nothing arrives before `until`."""
        while data := self._port.receive(until):
            others = self._without_own(data)
            if others:
                return others
        return b""

    def flush(self) -> None:
        while self._own and (data := self._port.receive(self._clock.now())):
            self._without_own(data)
        if not self._own:
            self._port.flush()

    def close(self) -> None:
        self._port.close()

    def _without_own(self, data: bytes) -> bytes:
        size = min(len(data), len(self._own))
        if data[:size] != self._own[:size]:  # another device talked at the same time
            self._own.clear()
            return data
        del self._own[:size]
        return data[size:]
