"""Watch a marker source: report the messages since the last line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Self

import numpy as np

from bodyschema.interfaces.protocols import Clock, MarkerSource
from bodyschema.interfaces.records import MarkerFix, MarkerMiss
from bodyschema.interfaces.rejections import WORDS

from .sampler.reconnect import ReconnectingSource
from .sampler.sources import ReportsHealth


class MarkerWatch:
    """A marker source that is read for display. It is reopened after a loss."""

    def __init__(self, name: str, source: MarkerSource, health: ReportsHealth, clock: Clock) -> None:
        """Store the settings; nothing is opened yet.

        Args:
            name: name of the source in messages.
            health: reports its problems.
        """
        self._name, self._health, self._clock = name, health, clock
        self._source = ReconnectingSource(source, f"the positions by {name}", clock)
        self._forget()

    def __enter__(self) -> Self:
        self._source.__enter__()
        self._forget()
        return self

    def __exit__(self, *_: object) -> None:
        self._source.__exit__()

    def read(self, timeout_s: float) -> None:
        """Read all positions that arrive within `timeout_s`."""
        end = self._clock.now() + timeout_s
        while (remaining_s := end - self._clock.now()) > 0:
            seen = self._source.read(remaining_s)
            if isinstance(seen, MarkerFix):
                self._fixes += 1
                self._last, self._delay_s = seen, self._clock.now() - seen.t
            elif isinstance(seen, MarkerMiss):
                self._misses[WORDS[seen.reason]] += 1

    def lines(self) -> Iterator[str]:
        """Yield the counts since the last call, then the problems."""
        passed_s = max(self._clock.now() - self._since, 1e-3)
        hidden = "".join(f", {count} {why}" for why, count in self._misses.items())
        if self._last is None:
            yield f"{self._name}: no position{hidden}"
        else:
            x = ", ".join(f"{1e3 * value:8.2f}" for value in self._last.x)
            sigma = 1e3 * float(np.sqrt(np.linalg.eigvalsh(self._last.cov)[-1]))
            yield (
                f"{self._name}: {self._fixes / passed_s:5.1f}/s  ({x}) mm ± {sigma:.2g}  measured "
                f"{1e3 * self._delay_s:.0f} ms ago ± {1e3 * self._last.t_sigma:.1f} ms{hidden}"
            )
        if self._source.trouble is not None:
            yield self._source.trouble
        else:
            yield from self._health.health
        self._forget()

    def _forget(self) -> None:
        self._since, self._fixes, self._misses = self._clock.now(), 0, Counter[str]()
        self._last: MarkerFix | None = None
        self._delay_s = 0.0
