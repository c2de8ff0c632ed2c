"""`bodyschema watch marker`: rate, position, delay, and what is wrong."""

from __future__ import annotations

import numpy as np
from scripted_sources import Scripted
from virtual_port import VirtualClock

from bodyschema.daemon.marker_watch import MarkerWatch
from bodyschema.interfaces.records import MarkerFix, MarkerMiss, Reason, frozen_array

COV = frozen_array(np.diag([1e-6, 1e-6, 4e-6]))


class Unwell:
    health = ("udp: 3 of the last 9 messages were lost: use a cable",)


class Timed(Scripted):
    """A source that takes 10 ms for each item."""

    def __init__(self, items, clock: VirtualClock) -> None:
        super().__init__(items)
        self._clock = clock

    def read(self, timeout_s: float):
        self._clock.wait_until(self._clock.now() + 0.01)
        return super().read(timeout_s)


def watched(items, seconds: float) -> list[str]:
    clock = VirtualClock()
    with MarkerWatch("udp", Timed(items, clock), Unwell(), clock) as watch:
        watch.read(seconds)
        return list(watch.lines())


def test_positions_are_shown_with_rate_and_delay() -> None:
    items = [MarkerFix(100.0 + 0.01 * k, frozen_array([0.1, -0.2, 0.3]), COV, t_sigma=0.001) for k in range(9)]
    first, second = watched([*items, MarkerMiss(100.095, Reason.NO_MARKER)], 0.1)
    assert first == ("udp:  90.0/s  (  100.00,  -200.00,   300.00) mm ± 2  measured 10 ms ago ± 1.0 ms, 1 no marker")
    assert second == Unwell.health[0]
