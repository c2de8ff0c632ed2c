"""A power loss at any moment of two working processes: accepted pairs survive, and the checkpoint is a valid one."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from failing_disk import Done, FailingDisk, Operation, read_log
from power_loss import Disk
from two_processes import KEYS, answer, ended_well, learner_with, running, write_robot

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.checkpoint import generations, read_checkpoint
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.transport.wire import CommandRequest, encode, pair_to_wire
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import StoreError
from bodyschema.recordings.store.store import PairReader, PairStore

CHECKPOINT = "learner.ckpt"


@dataclass
class Promised:
    """State that must survive whatever the disk lost.

    Attributes:
        accepted: number of the last pair that a sampler had accepted.
        possible: possible checkpoints: the last safe one and those after it; None for no checkpoint.
        previous: possible previous checkpoints. It may always be absent: it loses its name before the present one
            takes it.
    """

    accepted: int = 0
    possible: list[bytes | None] = field(default_factory=lambda: [None])
    previous: list[bytes | None] = field(default_factory=lambda: [None])

    def follow(self, done: Done, disk: Disk) -> None:
        """Record an operation."""
        if done.operation is Operation.RENAME and done.data.decode() == CHECKPOINT:
            self.previous += self.possible
            self.possible.append(bytes(disk.names[CHECKPOINT].present))
        elif done.operation is Operation.SYNC_FOLDER:
            self.possible = self.possible[-1:]
            self.previous = [None, *self.previous[-2:], *self.possible]
        elif done.operation is Operation.WRITE and done.data.rstrip().isdigit():
            self.accepted = int(done.data)


def work(config: Config, disk_shim: Path, pairs: int) -> Path:
    """Let both processes handle this many pairs, end them, and return the log of their disk operations."""
    disk = FailingDisk(config.state_dir, disk_shim)
    with ExitStack() as stack:
        children = [
            stack.enter_context(
                running(config, name, journal=config.state_dir / "journal", environment=disk.environment)
            )
            for name in ("sampler", "learner")
        ]
        learner_with(config, pairs)
        answer(config, "learner", KEYS.command("learner"), encode(CommandRequest("checkpoint")))
        assert all(map(ended_well, children))
    return disk.log


class Losses:
    """Repeated power losses during a replay of the disk operations, each checked against the promise."""

    def __init__(self, config: Config, folder: Path) -> None:
        self._config, self._folder = config, folder
        with PairReader(config.store_file) as store:
            self._pairs = [pair_to_wire(pair) for pair in store.read()]
        self.losses = self.torn = self.without_last = 0

    def at(self, moments: set[int], log: list[Done], rng: np.random.Generator) -> None:
        disk, promised = Disk(), Promised()
        for number, done in enumerate(log):
            disk.do(done)
            promised.follow(done, disk)
            if number in moments:
                shutil.rmtree(self._folder, ignore_errors=True)
                self._folder.mkdir()
                disk.after_power_loss(rng, self._folder)
                self._expect(promised, disk)

    def _expect(self, promised: Promised, disk: Disk) -> None:
        self.losses += 1
        store_file = self._folder / self._config.store_file.name
        self.torn += any(
            (self._folder / name).read_bytes() != bytes(file.present)
            for name, file in disk.names.items()
            if (self._folder / name).exists()
        )
        with PairStore(store_file, session_of(self._config, SystemClock())) as store:
            left = [pair_to_wire(pair) for pair in store.read()]
            identity = store.identity
        assert len(left) >= promised.accepted
        if left:
            assert identity == self._pairs[0].store
            assert left == self._pairs[: len(left)]
        for file, ones in zip(
            generations(self._folder / CHECKPOINT), (promised.possible, promised.previous), strict=True
        ):
            there = file.read_bytes() if file.exists() else None
            assert there in ones
            state = read_checkpoint(file, robot="arm")
            assert state is None or state.header.counters.last_seq <= len(left)


def lose_power(config: Config, folder: Path, log: list[Done], losses: int, seed: int) -> Losses:
    """Lose power at random moments, half of them around operations on the checkpoint and the folder."""
    rng = np.random.default_rng(seed)
    rare = [
        number
        for number, done in enumerate(log)
        if done.operation not in (Operation.WRITE, Operation.SYNC) or len(done.data) > 4096
    ]
    around = rng.choice(rare, losses // 2) + rng.integers(-1, 3, losses // 2)
    moments = {*rng.integers(len(log), size=losses - losses // 2).tolist(), *around.clip(0, len(log) - 1).tolist()}
    happened = Losses(config, folder)
    happened.at(moments, log, rng)
    return happened


def worked(folder: Path, endpoint: Callable[[], str], disk_shim: Path, pairs: int) -> tuple[Config, list[Done]]:
    """Return the robot of two processes that handled this many pairs, and the operations of their disk."""
    config = write_robot(folder, endpoint, pairs_per_s=400.0)
    return config, list(read_log(work(config, disk_shim, pairs)))


@pytest.fixture(scope="module")
def hundred(tmp_path_factory, free_endpoint, disk_shim) -> tuple[Config, list[Done]]:
    return worked(tmp_path_factory.mktemp("hundred"), free_endpoint, disk_shim, 100)


@pytest.mark.soak
def test_power_loss_keeps_pairs_and_a_checkpoint(tmp_path, hundred) -> None:
    config, log = hundred
    happened = lose_power(config, tmp_path / "after", log, losses=12, seed=0)
    assert happened.torn > 2  # the losses were some


@pytest.mark.soak
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("seed", [1, 2])
def test_power_losses_during_store_cleanup_lose_nothing(tmp_path, free_endpoint, disk_shim, seed) -> None:
    config, log = worked(tmp_path, free_endpoint, disk_shim, 1500)
    happened = lose_power(config, tmp_path / "after", log, losses=2000, seed=seed)
    assert happened.torn > 500


def without_syncs(log: list[Done]) -> list[Done]:
    return [done for done in log if done.operation not in (Operation.SYNC, Operation.SYNC_FOLDER)]


@pytest.mark.soak
def test_a_store_that_never_synced_would_lose_pairs(tmp_path, hundred) -> None:
    config, log = hundred[0], without_syncs(hundred[1])
    with pytest.raises((AssertionError, StoreError)):
        Losses(config, tmp_path / "after").at(set(range(len(log) - 40, len(log))), log, np.random.default_rng(0))
