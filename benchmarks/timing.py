"""Compare costs on a machine that others use too: variants take turns, and medians are compared."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping


def interleaved_medians_us(
    rivals: Mapping[str, Callable[[], object]],
    *,
    rounds: int = 40,
    calls: int = 200,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Return the median over rounds of the mean time of a call [us]; each round times all variants under the same load.

    Args:
        clock: returns [s]; time.thread_time excludes the CPU time of other programs.
    """
    times: dict[str, list[float]] = {name: [] for name in rivals}
    for call in rivals.values():
        call()
    for _ in range(rounds):
        for name, call in rivals.items():
            begin = clock()
            for _ in range(calls):
                call()
            times[name].append((clock() - begin) / calls * 1e6)
    return {name: statistics.median(samples) for name, samples in times.items()}
