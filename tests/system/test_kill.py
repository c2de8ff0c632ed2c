from __future__ import annotations

import contextlib
import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from killed_at import LEARNER_POINTS, NOWHERE, SAMPLER_POINTS
from two_processes import KEYS, LIFE_LIMIT_S, learner_with, pause, running, write_robot

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import PairMessage, decode, encode, pair_to_wire
from bodyschema.recordings.store.store import PairReader

# The last sampler goes on while learners are still killed: thousands of pairs are left to learn.
CATCH_UP_LIMIT_S = 900.0
LATEST_PAIR, LATEST_CHECKPOINT, LATEST_S = 40, 3, 1.0


@dataclass(frozen=True)
class Kill:
    """End of one life of a process.

    Attributes:
        point: a named point, at whose nth time the process dies; or NOWHERE.
        after_s: with NOWHERE, the time from its first sign of life, or from its start, to its death from outside.
        alive: True to wait for the sign of life; otherwise it may die while it starts.
    """

    point: str
    nth: int
    after_s: float
    alive: bool


def plan(rng: np.random.Generator, points: list[str], kills: int, latest: int) -> list[Kill]:
    """Return kills in random order: every third at a random moment, the others at the points in turn."""
    named = [points[k % len(points)] for k in range(kills - kills // 3)]
    order = rng.permutation([*named, *[NOWHERE] * (kills // 3)]).tolist()
    return [
        Kill(point, int(rng.integers(1, latest + 1)), rng.uniform(0, LATEST_S), rng.random() < 0.7) for point in order
    ]


def doomed(config: Config, process: str, kill: Kill) -> contextlib.AbstractContextManager[subprocess.Popen[bytes]]:
    """Run a process that is to die by `kill`."""
    return running(config, process, fate=(kill.point, str(kill.nth)))


class Lives:
    """The lives of one process, each ended by its kill, and a last one that continues until `__exit__`."""

    def __init__(self, config: Config, process: str, kills: list[Kill]) -> None:
        self.deaths: list[str] = []
        self._config, self._process, self._kills = config, process, kills
        self._born, self._last, self._enough = threading.Event(), threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._live, name=process)

    def __enter__(self) -> Lives:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._enough.set()
        self._thread.join()

    def wait(self) -> None:
        """Wait until the last life has begun."""
        self._last.wait()

    def _live(self) -> None:
        with ZenohSession(connect=getattr(self._config.tables.zenoh, self._process)) as witness:
            witness.watch(KEYS.alive(self._process), lambda alive: self._born.set() if alive else None)
            for kill in self._kills:
                self._born.clear()
                with doomed(self._config, self._process, kill) as child:
                    self.deaths.append(self._death(child, kill))
                if self.deaths[-1] != kill.point or self._enough.is_set():
                    break
        with running(self._config, self._process):
            self._last.set()
            self._enough.wait()

    def _death(self, child: subprocess.Popen[bytes], kill: Kill) -> str:
        """Return the point where the process died, or the event that came instead."""
        if kill.point == NOWHERE:
            return self._death_from_outside(child, kill)
        try:
            code = child.wait(LIFE_LIMIT_S)
        except subprocess.TimeoutExpired:
            return f"never came to {kill.point}"
        return kill.point if code == -9 else f"ended with exit code {code}"

    def _death_from_outside(self, child: subprocess.Popen[bytes], kill: Kill) -> str:
        if kill.alive and not self._born.wait(LIFE_LIMIT_S):
            return "never gave a sign of life"
        try:
            return f"ended with exit code {child.wait(kill.after_s)}"
        except subprocess.TimeoutExpired:
            return NOWHERE


@dataclass(frozen=True)
class Aftermath:
    """State after all kills, once the learner had time to catch up.

    Attributes:
        planned, deaths: planned and actual points of death.
        accepted: numbers of the pairs that a sampler had accepted before it died.
        published: the pairs that were heard on zenoh.
        unusable: checkpoints that a learner could not go on from.
    """

    planned: list[str]
    deaths: list[str]
    accepted: list[int]
    published: list[PairMessage]
    stored: list[PairMessage]
    learner: LearnerStatus
    unusable: list[Path]


def kill_again_and_again(config: Config, kills: int, seed: int) -> Aftermath:
    """Run both processes, kill each of them `kills` / 2 times, and see what is left in the end."""
    rng = np.random.default_rng(seed)
    sampler = plan(rng, list(SAMPLER_POINTS), kills // 2, LATEST_PAIR)
    learner = plan(rng, list(LEARNER_POINTS), kills - kills // 2, LATEST_CHECKPOINT)
    published: list[PairMessage] = []
    with (
        ZenohSession(connect=config.tables.zenoh.sampler) as witness,
        Lives(config, "sampler", sampler) as samplers,
        Lives(config, "learner", learner) as learners,
    ):
        witness.subscribe(KEYS.pair, lambda payload: published.append(decode(payload, PairMessage)))
        samplers.wait()
        learners.wait()
        pairs = pause(config)
        status = learner_with(config, pairs, CATCH_UP_LIMIT_S)
    with PairReader(config.store_file) as store:
        stored = [decode(encode(pair_to_wire(pair)), PairMessage) for pair in store.read()]
    return Aftermath(
        planned=[kill.point for kill in sampler + learner],
        deaths=samplers.deaths + learners.deaths,
        accepted=[int(line) for line in config.file.with_name("journal").read_text().splitlines()],
        published=published,
        stored=stored,
        learner=status,
        unusable=list(config.state_dir.glob("*.unusable-*")),
    )


@pytest.fixture(scope="module")
def aftermath(tmp_path_factory: pytest.TempPathFactory, free_endpoint: Callable[[], str]) -> Aftermath:
    return kill_again_and_again(write_robot(tmp_path_factory.mktemp("kill"), free_endpoint), kills=8, seed=0)


def numbers(pairs: list[PairMessage]) -> list[int]:
    return [pair.seq for pair in pairs]


def test_every_kill_comes_where_it_was_planned(aftermath: Aftermath) -> None:
    assert len(aftermath.deaths) == 8
    assert aftermath.deaths == aftermath.planned
    assert set(aftermath.deaths) == {*SAMPLER_POINTS, *LEARNER_POINTS, NOWHERE}


def expect_every_accepted_pair_stored_once(aftermath: Aftermath) -> None:
    assert numbers(aftermath.stored) == list(range(1, len(aftermath.stored) + 1))
    assert aftermath.accepted == sorted(set(aftermath.accepted))  # no number was given twice
    assert set(aftermath.accepted) <= set(numbers(aftermath.stored))


def test_a_killed_sampler_loses_no_accepted_pair(aftermath: Aftermath) -> None:
    expect_every_accepted_pair_stored_once(aftermath)


def expect_every_published_pair_in_the_store(aftermath: Aftermath) -> None:
    heard = numbers(aftermath.published)
    assert heard
    assert heard == sorted(set(heard))
    assert aftermath.published == [aftermath.stored[number - 1] for number in heard]


def test_published_pair_is_stored_unchanged_and_once(aftermath: Aftermath) -> None:
    expect_every_published_pair_in_the_store(aftermath)


def expect_every_pair_learnt_once(aftermath: Aftermath) -> None:
    learner, count = aftermath.learner, len(aftermath.stored)
    assert (learner.pairs, learner.last_seq, learner.refused) == (count, count, 0)


def test_a_killed_learner_learns_every_accepted_pair_once(aftermath: Aftermath) -> None:
    expect_every_pair_learnt_once(aftermath)


def test_kills_always_leave_a_usable_checkpoint(aftermath: Aftermath) -> None:
    assert aftermath.unusable == []


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [1, 2])
def test_two_hundred_kills_lose_nothing(tmp_path: Path, free_endpoint, seed: int) -> None:
    aftermath = kill_again_and_again(write_robot(tmp_path, free_endpoint), kills=200, seed=seed)
    assert aftermath.deaths == aftermath.planned
    expect_every_accepted_pair_stored_once(aftermath)
    expect_every_published_pair_in_the_store(aftermath)
    expect_every_pair_learnt_once(aftermath)
    assert aftermath.unusable == []


@pytest.mark.parametrize(
    ("point", "stored"), [("at the commit", 16), ("before the publication", 17), ("after the publication", 17)]
)
def test_killed_sampler_leaves_exactly_committed_pairs(tmp_path: Path, free_endpoint, point: str, stored: int) -> None:
    config = write_robot(tmp_path, free_endpoint, rows=40)
    with doomed(config, "sampler", Kill(point, 17, 0.0, False)) as child:
        assert child.wait(LIFE_LIMIT_S) == -9
    with PairReader(config.store_file) as reader:
        assert [pair.seq for pair in reader.read()] == list(range(1, stored + 1))
