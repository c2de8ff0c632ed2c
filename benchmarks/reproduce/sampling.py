"""Make pairs with the daemon's sampler, from sources that run as long as pairs are wanted."""

from __future__ import annotations

import time
from dataclasses import replace
from types import TracebackType
from typing import Self

import numpy as np

from bodyschema.cli.terminal.screen import Say, ScreenSettings
from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.sampler.sampler import Sampler
from bodyschema.daemon.sampler.sources import Sources
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceEnded, SourceError
from bodyschema.interfaces.protocols import MarkerSource
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss
from bodyschema.recordings.store.store import PairReader, PairStore


class _Enough:
    """A marker source that ends once the store has enough pairs."""

    def __init__(self, marker: MarkerSource, stored: PairReader, count: int, say: Say) -> None:
        self._marker, self._stored, self._count, self._say = marker, stored, count, say
        self._told = time.monotonic()

    def __enter__(self) -> Self:
        self._marker.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._marker.__exit__(kind, error, trace)

    def read(self, timeout_s: float) -> MarkerFix | MarkerMiss | None:
        pairs = self._stored.last_seq()
        if pairs >= self._count:
            raise SourceEnded("there are enough pairs")
        if time.monotonic() - self._told >= ScreenSettings.tell_every_s:
            self._told = time.monotonic()
            self._say(f"{pairs:,} of {self._count:,} pairs sampled")
        return self._marker.read(timeout_s)


def sampled(config: Config, sources: Sources, count: int, say: Say) -> tuple[FloatArray, FloatArray]:
    """Return the first pairs that the sampler accepts: q (count, d) [rad or m] and x (count, 3) [m].

    Raises:
        SourceError: the sources ended too early.
        StoreError: the store cannot be written.
    """
    with ZenohSession() as bus, PairStore(config.store_file, session_of(config, SystemClock())) as store:
        counted = replace(sources, marker=_Enough(sources.marker, store.reader, count, say))
        Sampler(config, counted, bus, store, exit_at_end=True).run()
        pairs = store.reader.read()
    if len(pairs) < count:
        raise SourceError(f"the sampler accepted {len(pairs)} of {count} pairs before the sources ended")
    return np.array([pair.q for pair in pairs]), np.array([pair.x for pair in pairs])
