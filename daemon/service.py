"""A process as a service: ready when it works, watched by its working loops, with a line about how it is."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Collection, Sequence

from bodyschema.interfaces.protocols import Clock

from .notify import Notifier

# systemd waits for so many times longer than the time between two signs of life.
SIGNS_PER_WATCHDOG = 4
SETTLED_S = 3.0  # a device that was plugged in gets its group a moment after its name


class Service:
    """What systemd is told of a process with working loops; from any thread.

    Each loop says `beat` whenever it comes round. The watchdog is fed when all of them have since it was last fed, so
    that one loop which hangs, whichever it is, starves it.
    """

    def __init__(
        self,
        notifier: Notifier,
        loops: Collection[str],
        clock: Clock,
        *,
        devices: Sequence[str] = (),
        may_open: Callable[[str], bool] = lambda device: os.access(device, os.R_OK | os.W_OK),
    ) -> None:
        """Not ready yet.

        Args:
            loops: names of the loops that have to come round.
            devices: what the service was allowed when it was started; access(2) knows of that, too.
        """
        self._devices = devices if notifier.is_heard else ()
        self._may_open, self._forbidden_since = may_open, math.inf
        self._notifier, self._clock = notifier, clock
        self._loops = set(loops)
        self._round: set[str] = set()
        self._every_s = None if notifier.watchdog_s is None else notifier.watchdog_s / SIGNS_PER_WATCHDOG
        self._next_feed = clock.now()
        self._lock = threading.Lock()
        self._ready = False
        self._said = ""

    @classmethod
    def nobodys(cls, clock: Clock) -> Service:
        """Of a process that no systemd started."""
        return cls(Notifier(), (), clock)

    def beat(self, loop: str) -> None:
        """The loop of this name came round."""
        if self._every_s is None:
            return
        with self._lock:
            self._round.add(loop)
            self._feed_when_due(self._every_s)

    def leave(self, loop: str) -> None:
        """The loop of this name has come to its end, as it should: nobody waits for it any more."""
        with self._lock:
            self._loops.discard(loop)

    def ready(self) -> None:
        """All is up. Said once; later calls do nothing."""
        if not self._ready:
            self._ready = True
            self._notifier.ready()

    def forbidden(self) -> str | None:
        """A device that is there and has not been this service's to open for a while; None where there is none.

        systemd resolves the names of devices when it starts a service. One that comes back under another number is
        the service's after a new start.
        """
        found = next((name for name in self._devices if os.path.exists(name) and not self._may_open(name)), None)
        now = self._clock.now()
        self._forbidden_since = math.inf if found is None else min(self._forbidden_since, now)
        return found if now - self._forbidden_since >= SETTLED_S else None

    def reloading(self) -> None:
        """The configuration is read again, until `reloaded`."""
        self._notifier.reloading()

    def reloaded(self) -> None:
        """The configuration was read again."""
        self._notifier.ready()

    def tell(self, line: str) -> None:
        """How the process is, in one line."""
        if line != self._said:
            self._said = line
            self._notifier.status(line)

    def stopping(self) -> None:
        """The process comes to its end."""
        self._notifier.stopping()

    def _feed_when_due(self, every_s: float) -> None:
        now = self._clock.now()
        if self._loops <= self._round and now >= self._next_feed:
            self._round.clear()
            self._next_feed = now + every_s
            self._notifier.feed_watchdog()


def with_health(line: str, health: Sequence[str]) -> str:
    """A line about how a process is, with the first thing that is wrong."""
    if not health:
        return line
    more = f" (and {len(health) - 1} more)" if len(health) > 1 else ""
    return f"{line}. {health[0]}{more}"
