"""Notify systemd of a service's state by sd_notify(3): datagrams to the socket in NOTIFY_SOCKET."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import MutableMapping

log = logging.getLogger(__name__)

SOCKET, WATCHDOG, WATCHDOG_PID = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"


class NotifySettings:
    send_limit_s: float = 0.5  # sent by the working loops: a systemd that does not listen must not block them
    longest_status: int = 400  # characters
    # systemd waits this long for a start, and again from each sign of life, which is sent this often [s].
    start_limit_s, extend_every_s = 90, 5.0


class Notifier:
    """Notifier of systemd; it does nothing without a socket.

    Attributes:
        watchdog_s: systemd ends the process after this long without `WATCHDOG=1` [s]; None without a watchdog.
    """

    def __init__(self, address: str | None = None, watchdog_s: float | None = None) -> None:
        """Notify the socket at `address`, a path or with a leading `@` an abstract name; None to do nothing."""
        is_abstract = address is not None and address.startswith("@")
        self._address = f"\0{address[1:]}" if address and is_abstract else address
        self._failed = False
        self._next_extension = 0.0
        self.watchdog_s = None if address is None else watchdog_s

    @classmethod
    def of_environment(cls, environment: MutableMapping[str, str] = os.environ) -> Notifier:
        """Return the notifier that systemd requested; remove the request from the environment of later children."""
        address = environment.pop(SOCKET, None) or None
        microseconds, pid = environment.pop(WATCHDOG, ""), environment.pop(WATCHDOG_PID, "")
        ours = not pid or pid == str(os.getpid())
        watched = ours and microseconds.isdigit() and int(microseconds) > 0
        return cls(address, int(microseconds) / 1e6 if watched else None)

    @property
    def is_connected(self) -> bool:
        """True if systemd started this process and listens."""
        return self._address is not None

    def ready(self) -> None:
        """Report that the start, or the reload after `reloading`, is complete."""
        self._send("READY=1")

    def starting(self) -> None:
        """Report progress of the start, as often as you like: systemd waits for `start_limit_s` from now."""
        now = time.monotonic()
        if now >= self._next_extension:
            self._next_extension = now + NotifySettings.extend_every_s
            self._send(f"EXTEND_TIMEOUT_USEC={NotifySettings.start_limit_s * 1_000_000}")

    def reloading(self) -> None:
        """Report that the configuration is being read again; `ready` ends this."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def stopping(self) -> None:
        """Report that the process is stopping."""
        self._send("STOPPING=1")

    def status(self, line: str) -> None:
        """Send one line that `systemctl status` shows."""
        self._send(f"STATUS={' '.join(line.split())[: NotifySettings.longest_status]}")

    def feed_watchdog(self) -> None:
        """Report that the process works."""
        self._send("WATCHDOG=1")

    def _send(self, state: str) -> None:
        if self._address is None:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sending:
                sending.settimeout(NotifySettings.send_limit_s)
                sending.sendto(state.encode(), self._address)
        except OSError as error:
            if not self._failed:
                log.warning("cannot notify systemd of %s: %s", state.partition("=")[0], error.strerror or error)
            self._failed = True
        else:
            self._failed = False
