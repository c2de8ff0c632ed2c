"""Report a process to systemd: readiness, a watchdog fed by its working loops, and a status line."""

from __future__ import annotations

import logging
import math
import os
import threading
from collections.abc import Callable, Collection, Sequence

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.protocols import Clock

from .notify import Notifier

log = logging.getLogger(__name__)


class _Settings:
    signs_per_watchdog: int = 4  # systemd's timeout as a multiple of the interval between two signs of life
    settled_s: float = 3.0  # a device that was plugged in gets its group a moment after its name


class Service:
    """Reporter of a process with working loops to systemd; from any thread.

    Each loop calls `beat` in every round. The watchdog is fed once all loops have called it since the last feed, so a
    single hanging loop starves it.
    """

    def __init__(
        self,
        notifier: Notifier,
        loops: Collection[str],  # names of the loops that have to keep running
        clock: Clock,
        *,
        devices: Sequence[str] = (),  # devices that systemd lets the service open; access(2) gives the same result
        may_open: Callable[[str], bool] = lambda device: os.access(device, os.R_OK | os.W_OK),
    ) -> None:
        """Start in the state "not ready"."""
        self._devices = devices if notifier.is_connected else ()
        self._may_open, self._forbidden_since = may_open, math.inf
        self._notifier, self._clock = notifier, clock
        self._loops = set(loops)
        self._round: set[str] = set()
        self._every_s = None if notifier.watchdog_s is None else notifier.watchdog_s / _Settings.signs_per_watchdog
        self._next_feed = clock.now()
        self._lock = threading.Lock()
        self._ready = False
        self._last_status = ""

    @classmethod
    def unsupervised(cls, clock: Clock) -> Service:
        """Return a service for a process that systemd did not start."""
        return cls(Notifier(), (), clock)

    def beat(self, loop: str) -> None:
        """Note a round of the loop of this name."""
        if self._every_s is None:
            return
        with self._lock:
            self._round.add(loop)
            now = self._clock.now()
            if self._loops <= self._round and now >= self._next_feed:
                self._round.clear()
                self._next_feed = now + self._every_s
                self._notifier.feed_watchdog()

    def remove_loop(self, loop: str) -> None:
        """Note that the loop of this name has ended as intended: the watchdog no longer waits for it."""
        with self._lock:
            self._loops.discard(loop)

    def ready(self) -> None:
        """Report that everything is up. Later calls do nothing."""
        if not self._ready:
            self._ready = True
            self._notifier.ready()

    def forbidden(self) -> str | None:
        """Return an existing device that this service has not been able to open for a while, or None.

        systemd resolves device names when it starts a service. A device that comes back under another number is
        accessible after a restart of the service.
        """
        found = next((name for name in self._devices if os.path.exists(name) and not self._may_open(name)), None)
        now = self._clock.now()
        self._forbidden_since = math.inf if found is None else min(self._forbidden_since, now)
        return found if now - self._forbidden_since >= _Settings.settled_s else None

    def reload_and_report(self, reload: Callable[[], str]) -> None:
        """Report that robot.toml is read again by `reload`. Log its result, since a signal has no reply."""
        self._notifier.reloading()
        try:
            log.info("robot.toml was read again: %s", reload())
        except BodyschemaError as error:
            log.error("robot.toml was read again and is not followed: %s", error)
        finally:
            self._notifier.ready()

    def report_status(self, line: str) -> None:
        """Report the state of the process in one line."""
        if line != self._last_status:
            self._last_status = line
            self._notifier.status(line)

    def stopping(self) -> None:
        """Report that the process is stopping."""
        self._notifier.stopping()


def with_health(line: str, health: Sequence[str]) -> str:
    """Return a line about the state of a process, with the first problem appended."""
    if not health:
        return line
    more = f" (and {len(health) - 1} more)" if len(health) > 1 else ""
    return f"{line}. {health[0]}{more}"
