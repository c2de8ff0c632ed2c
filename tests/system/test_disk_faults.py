"""Disks that are full, read-only, broken or slow while both processes work, and files that came back damaged."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from failing_disk import FailingDisk
from two_processes import (
    KEYS,
    answer,
    ended_well,
    expect_each_pair_learnt_once,
    learner_with,
    pause,
    running,
    sampler_with,
    status_when,
    write_robot,
)

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.checkpoint import generations
from bodyschema.daemon.transport.session import client
from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import CommandRequest, encode
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.recordings.store.store import PairReader

SOME, MORE = 20, 20


def health(config: Config, process: str, kind: type, said: str) -> str:
    """Return the process's health message that contains `said`, as soon as there is one."""
    found = status_when(config, process, kind, lambda status: any(said in text for text in status.health))
    return next(text for text in found.health if said in text)


def healthy_again(config: Config, process: str, kind: type, said: str) -> None:
    """Wait until the process no longer says so."""
    status_when(config, process, kind, lambda status: not any(said in text for text in status.health))


def refuses_a_checkpoint(config: Config) -> None:
    """Ask the learner for a checkpoint that it cannot write: by itself it writes none where it has learnt nothing."""
    with client(config.tables.zenoh.learner) as bus, pytest.raises(BodyschemaError, match="checkpoint"):
        bus.ask_one(KEYS.command("learner"), encode(CommandRequest("checkpoint")))


def fill(file: Path) -> None:
    """Let the file take all the room that its disk has."""
    with contextlib.suppress(OSError), file.open("wb", buffering=0) as stream:
        while stream.write(bytes(512)):
            pass


# --- a disk that takes nothing for a while


def test_both_processes_report_unwritable_disk_and_continue(tmp_path, free_endpoint, disk_shim) -> None:
    config = write_robot(tmp_path, free_endpoint)
    disk = FailingDisk(config.state_dir, disk_shim)
    with (
        running(config, "sampler", environment=disk.environment),
        running(config, "learner", environment=disk.environment),
    ):
        learner_with(config, SOME)
        for number, said in ((errno.ENOSPC, "is full"), (errno.EIO, "disk I/O error")):
            disk.refuse(number)
            text = health(config, "sampler", SamplerStatus, "No samples are taken until the disk does")
            assert said in text
            assert str(config.store_file) in text
            refuses_a_checkpoint(config)
            health(config, "learner", LearnerStatus, "the checkpoint")
            stopped = sampler_with(config, 0)
            assert json.loads(answer(config, "learner", KEYS.predict, b'{"q": [0.1, 0.2]}'))["pairs"] >= SOME
            disk.refuse(0)
            sampler_with(config, stopped.pairs + MORE)
            healthy_again(config, "sampler", SamplerStatus, "disk")
            healthy_again(config, "learner", LearnerStatus, "the checkpoint")
        expect_each_pair_learnt_once(config)


def test_freed_disk_resumes_without_gap(tmp_path, free_endpoint, mount_small_disk) -> None:
    folder = mount_small_disk("size=1m")
    config = write_robot(tmp_path, free_endpoint, state_dir=folder)
    ballast = folder / "ballast"
    with running(config, "sampler"), running(config, "learner"):
        learner_with(config, SOME)
        fill(ballast)
        assert "is full" in health(config, "sampler", SamplerStatus, "No samples are taken")
        stopped = sampler_with(config, 0).pairs
        ballast.unlink()
        sampler_with(config, stopped + MORE)
        status = expect_each_pair_learnt_once(config)
    with PairReader(config.store_file) as store:
        assert [pair.seq for pair in store.read()] == list(range(1, status.pairs + 1))


@pytest.mark.soak
def test_slow_disk_is_reported_and_loses_nothing(tmp_path, free_endpoint, disk_shim) -> None:
    config = write_robot(tmp_path, free_endpoint)
    disk = FailingDisk(config.state_dir, disk_shim)
    with running(config, "sampler", environment=disk.environment), running(config, "learner"):
        learner_with(config, SOME)
        disk.slow(150)
        assert str(config.store_file) in health(config, "sampler", SamplerStatus, "is slow: a sample took")
        answer(config, "learner", KEYS.predict, b'{"q": [0.1, 0.2]}')
        disk.slow(0)
        expect_each_pair_learnt_once(config)


# --- checkpoints that came back damaged


def truncated(data: bytes) -> bytes:
    return data[: len(data) // 2]


def flipped(data: bytes) -> bytes:
    place = int(np.random.default_rng(0).integers(len(data)))
    return data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :]


def emptied(_data: bytes) -> bytes:
    return b""


def zeroed(data: bytes) -> bytes:
    return bytes(len(data))


@pytest.fixture(scope="module")
def worked(tmp_path_factory: pytest.TempPathFactory, free_endpoint) -> Config:
    """Return a robot whose two processes have run and ended, with two generations of checkpoints."""
    config = write_robot(tmp_path_factory.mktemp("worked"), free_endpoint, rows=60)
    with ExitStack() as stack:
        children = [stack.enter_context(running(config, name)) for name in ("sampler", "learner")]
        learner_with(config, SOME)
        answer(config, "learner", KEYS.command("learner"), encode(CommandRequest("checkpoint")))
        learner_with(config, pause(config))
        answer(config, "learner", KEYS.command("learner"), encode(CommandRequest("checkpoint")))
        assert all(map(ended_well, children))
    return config


def damage(config: Config, how: Callable[[bytes], bytes], generation: int) -> None:
    file = generations(config.checkpoint_file)[generation]
    data = file.read_bytes()
    file.unlink()  # the generations may be one file with two names
    file.write_bytes(how(data))


@pytest.fixture
def kept(worked: Config) -> Config:
    """Yield the same robot, to be damaged; its files are restored afterwards."""
    files = {file: file.read_bytes() for file in generations(worked.checkpoint_file)}
    for aside in worked.state_dir.glob("*.unusable-*"):
        aside.unlink()
    yield worked
    for file, data in files.items():
        file.unlink(missing_ok=True)
        file.write_bytes(data)


@pytest.mark.parametrize(
    "how", [flipped, *(pytest.param(how, marks=pytest.mark.soak) for how in (truncated, emptied, zeroed))]
)
def test_damaged_checkpoint_falls_back_to_previous_one(kept, how) -> None:
    damage(kept, how, 0)
    with running(kept, "learner"):
        text = health(kept, "learner", LearnerStatus, "the learner went on from")
    assert f"the learner went on from {generations(kept.checkpoint_file)[1]} with" in text
    assert f"It was kept as {kept.checkpoint_file}.unusable-1" in text


def test_two_damaged_checkpoints_relearn_the_store(kept) -> None:
    for generation in (0, 1):
        damage(kept, flipped, generation)
    with running(kept, "sampler"), running(kept, "learner"):
        assert "learns again from the sampler's history" in health(kept, "learner", LearnerStatus, "damaged")
        expect_each_pair_learnt_once(kept)


@pytest.mark.soak
def test_file_size_limit_is_reported(tmp_path, free_endpoint) -> None:
    config = write_robot(tmp_path, free_endpoint)
    limited = ("prlimit", f"--fsize={256 * 1024}")
    if not any(os.access(f"{folder}/prlimit", os.X_OK) for folder in os.environ["PATH"].split(":")):
        pytest.skip("no prlimit; to run it: apt-get install util-linux")
    with running(config, "sampler", prefix=limited):
        text = health(config, "sampler", SamplerStatus, "No samples are taken until the disk does")
        stopped = sampler_with(config, 0).pairs
    assert str(config.store_file) in text
    with PairReader(config.store_file) as store:
        assert store.last_seq() >= stopped
