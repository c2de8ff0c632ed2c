"""Serve a device on a pseudo-terminal, which any program opens like a serial port."""

from __future__ import annotations

import fcntl
import math
import os
import select
import struct
import termios
import threading
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from heapq import heappop, heappush
from pathlib import Path
from typing import Self

from .device import Device, Reply, byte_s

_BAUDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
LINE_SPEED = 5  # index of the output speed in termios.tcgetattr
# <asm-generic/termbits.h>: the only call that returns any rate; tcgetattr knows only the standard rates.
TCGETS2, TERMIOS2 = 0x802C542A, struct.Struct("=4I20s2I")


class PtyShell:
    """A device on a pseudo-terminal whose name stays the same when it is unplugged and plugged in again.

    Answers take the time they would take on a wire at the baud rate of the opened port.
    """

    def __init__(self, device: Device, link: Path, now: Callable[[], float] = time.monotonic) -> None:
        """Prepare the port without opening it.

        Args:
            link: path of the port, a symbolic link.
            now: the clock of the device; it has to run at the rate of the machine's clock.
        """
        self.device, self.link = device, link
        self._now = now
        self._serving: _Serving | None = None

    def __enter__(self) -> Self:
        self.plug_in()
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()

    def plug_in(self) -> None:
        """Create the port."""
        if self._serving is None:
            self._serving = _Serving(self.device, self._now)
            self.link.unlink(missing_ok=True)
            self.link.symlink_to(self._serving.name)

    def unplug(self) -> None:
        """Remove the port, also for a program that has it open. The servos keep their power."""
        if self._serving is not None:
            self.link.unlink(missing_ok=True)
            self._serving.stop()
            self._serving = None


class _Serving:
    """One pseudo-terminal, from plug-in to unplug, and the thread that serves it."""

    def __init__(self, device: Device, now: Callable[[], float]) -> None:
        self._device, self._now = device, now
        # The slave end stays open: without a reader on it, reading the master fails.
        self._master, self._slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._wake, self._waker = os.pipe()
        self.name = os.ttyname(self._slave)
        self._due: list[tuple[float, int, bytes]] = []
        self._order = 0
        self._thread = threading.Thread(target=self._serve, name="emulator")
        self._thread.start()

    def stop(self) -> None:
        os.write(self._waker, b"x")
        self._thread.join()
        for descriptor in (self._master, self._slave, self._wake, self._waker):
            os.close(descriptor)

    def _serve(self) -> None:
        while True:
            wait_s = max(0.0, self._next - self._now())
            readable, _, _ = select.select((self._master, self._wake), (), (), None if wait_s == math.inf else wait_s)
            if self._wake in readable:
                return
            if self._master in readable:
                self._hear(os.read(self._master, 4096))
            if self._device.speaks_at <= self._now():
                self._bring(self._device.speak(self._now(), self._baud), self._baud)
            while self._due and self._due[0][0] <= self._now():
                with suppress(BlockingIOError):  # the buffer is full because no program reads: this packet is lost
                    os.write(self._master, heappop(self._due)[2])

    @property
    def _next(self) -> float:
        return min(self._due[0][0] if self._due else math.inf, self._device.speaks_at)

    @property
    def _baud(self) -> int:
        return _line_speed(self._slave) or 38_400  # a terminal's rate that was never set

    def _hear(self, data: bytes) -> None:
        self._bring(self._device.send(data, self._now(), self._baud), self._baud)

    def _bring(self, replies: list[Reply], baud: int) -> None:
        for reply in replies:
            self._order += 1
            end = reply.start + len(reply.data) * byte_s(baud)
            heappush(self._due, (end, self._order, reply.data))


def _line_speed(descriptor: int) -> int:
    """Return the baud rate of a terminal [bit/s]; 0 if it was never set."""
    try:
        *_, speed = TERMIOS2.unpack(fcntl.ioctl(descriptor, TCGETS2, bytes(TERMIOS2.size)))
    except OSError:  # a system without this call
        return _BAUDS.get(termios.tcgetattr(descriptor)[LINE_SPEED], 0)
    return speed
