"""Many hours of work in minutes: neither process grows, and no answer becomes slower."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from two_processes import KEYS, expect_each_pair_learnt_once, learner_with, running, write_robot

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession, client
from bodyschema.daemon.transport.wire import JointsRequest, encode

# By then all that is kept of pairs is full: replay, the solvers' windows, the publisher's cache.
WARM, PART, PARTS = 24_000, 6_000, 6
PAIRS_PER_S = 500.0
LONG_S = 3000.0
ASKED = 300
NOTHING = Keys("nobody").status("sampler")
MB = 2**20


def tree(pid: int) -> list[int]:
    """Return the process and all its descendants."""
    below = [
        int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()
    ]
    return [pid, *(each for child in below for each in tree(child))]


def resident_bytes(pid: int) -> int:
    """Return the memory private to the process and its descendants."""
    pages = (int(Path(f"/proc/{each}/statm").read_text().split()[1]) for each in tree(pid))
    return os.sysconf("SC_PAGE_SIZE") * sum(pages)


def cpu_s(pid: int) -> float:
    """Return the processor time that they have used."""
    fields = (Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split() for each in tree(pid))
    return sum(int(each[11]) + int(each[12]) for each in fields) / os.sysconf("SC_CLK_TCK")


def latency_s(ask: Callable[[], object]) -> float:
    """Return the answer time without other load: the lower quartile."""
    taken: list[float] = []
    for _ in range(ASKED):
        begun = time.perf_counter()
        ask()
        taken.append(time.perf_counter() - begun)
    return float(np.quantile(taken, 0.25))


@dataclass(frozen=True)
class Look:
    """Both processes at one moment; first the sampler, then the learner.

    Attributes:
        memory: resident [bytes].
        cpu: processor time so far [s].
        latency: of an answer, in round trips at that moment to who knows nothing and answers at once.
    """

    memory: tuple[int, int]
    cpu: tuple[float, float]
    latency: tuple[float, float]


def look(pids: tuple[int, int], sampler: ZenohSession, learner: ZenohSession, idle: ZenohSession) -> Look:
    question = encode(JointsRequest([0.1, 0.2]))
    asked = (
        latency_s(lambda: sampler.ask_one(KEYS.status("sampler"))),
        latency_s(lambda: learner.ask_one(KEYS.predict, question)),
    )
    round_trip = latency_s(lambda: idle.ask_one(NOTHING))
    memory, cpu = (tuple(map(of, pids)) for of in (resident_bytes, cpu_s))
    return Look(memory, cpu, (asked[0] / round_trip, asked[1] / round_trip))


def watched(config: Config, endpoint: str) -> list[Look]:
    """Measure after the warm-up and after each further part; `endpoint` is free."""
    zenoh = config.tables.zenoh
    with (
        ZenohSession(listen=endpoint) as idle,
        running(config, "sampler") as sampler,
        running(config, "learner") as learner,
    ):
        idle.answer(NOTHING, lambda _: b"")
        looks: list[Look] = []
        for part in range(PARTS + 1):
            learner_with(config, WARM + part * PART, limit_s=LONG_S)
            with client(zenoh.sampler) as to_sampler, client(zenoh.learner) as to_learner, client(endpoint) as to_idle:
                looks.append(look((sampler.pid, learner.pid), to_sampler, to_learner, to_idle))
            print(part, looks[-1], flush=True)
        expect_each_pair_learnt_once(config, LONG_S)
    return looks


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_memory_and_latency_stay_constant_over_hours(tmp_path, free_endpoint) -> None:
    config = write_robot(tmp_path, free_endpoint, rows=WARM + (PARTS + 4) * PART, pairs_per_s=PAIRS_PER_S)
    looks = watched(config, free_endpoint())
    memory, latency = (np.array([getattr(each, name) for each in looks], dtype=float) for name in ("memory", "latency"))
    work = np.diff([each.cpu for each in looks], axis=0)
    half = len(looks) // 2
    assert (memory[half:].max(axis=0) - memory[:half].max(axis=0) < 4 * MB).all()
    assert (latency[half:].min(axis=0) < 1.5 * latency[:half].min(axis=0)).all()
    assert (work[half:].min(axis=0) < 1.3 * work[:half].min(axis=0)).all()
