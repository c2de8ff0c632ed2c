"""A small robot whose sampler plays a recording, its two processes, and their answers."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np
import warm
from killed_at import NOWHERE
from small_arm import URDF

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import client
from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import CommandRequest, decode, encode
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.recordings.recording import Recording

# It only ends a test that would never end; on a busy machine everything here takes longer, and passes.
LIFE_LIMIT_S = 500.0
KEYS = Keys("arm")
PAIRS_PER_S = 60.0
CHECKPOINT_EVERY_S = 0.2
_walks: dict[tuple[int, float], bytes] = {}  # text of recordings: it takes half a second to write
S = TypeVar("S", SamplerStatus, LearnerStatus)
Process = subprocess.Popen[bytes] | warm.Child
ROBOT = """[robot]
name = "arm"
urdf = "arm.urdf"
joints = ["waist", "shoulder"]
marker_link = "hand"
marker_xyz = [0.2, 0.0, 0.0]
[camera]
parent_link = "base"
[zenoh]
sampler = "{sampler}"
learner = "{learner}"
[drivers]
recording = "walk.csv"
[daemon]
state_dir = "{state_dir}"
any_step = true
[learner]
checkpoint_every_s = {checkpoint_every_s}
"""


def write_robot(
    folder: Path,
    endpoint: Callable[[], str],
    rows: int = 30_000,
    pairs_per_s: float = PAIRS_PER_S,
    state_dir: Path = Path("state"),
) -> Config:
    """Write a robot whose encoders and camera are the recording of a walk."""
    (folder / "arm.urdf").write_text(URDF)
    robot_file = folder / "robot.toml"
    values = {"state_dir": state_dir, "checkpoint_every_s": CHECKPOINT_EVERY_S}
    robot_file.write_text(ROBOT.format(sampler=endpoint(), learner=endpoint(), **values))
    config = Config.load(robot_file, {})
    file = folder / "walk.csv"
    if (rows, pairs_per_s) not in _walks:
        t = np.arange(rows) / pairs_per_s
        q = np.stack([1.5 * np.sin(0.3 * t), 1.2 * np.sin(0.17 * t + 1.0)], axis=1)
        x = config.robot.chain.with_tool([0.03, 0.01, -0.02]).positions(q)
        Recording(config.robot.joints, q, x, t).write_csv(file)
        _walks[rows, pairs_per_s] = file.read_bytes()
    file.write_bytes(_walks[rows, pairs_per_s])
    return config


@contextlib.contextmanager
def running(
    config: Config,
    process: str,
    *,
    fate: tuple[str, str] = (NOWHERE, "0"),
    journal: Path | None = None,
    environment: Mapping[str, str] | None = None,
    prefix: tuple[str, ...] = (),
) -> Iterator[Process]:
    """Run a process of the project; kill it at the end of the with statement if it still runs.

    Args:
        fate: at which point of `killed_at`, and at whose which time, it dies.
        journal: file for the numbers of accepted pairs; beside robot.toml if None.
        environment: variables beside those of this process.
        prefix: words before the command.
    """
    wrapper, notes = Path(__file__).with_name("killed_at.py"), journal or config.file.with_name("journal")
    words = [wrapper, *fate, notes, "run", process, "--robot", config.file]
    with (config.file.parent / f"{process}.log").open("ab") as log:
        if environment or prefix:  # the environment applies to new processes
            command, variables = [*prefix, sys.executable, *words], {**os.environ, **(environment or {})}
            child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=log, env=variables)
        else:
            child = warm.Child(*words, stderr=log)
    try:
        yield child
    finally:
        child.kill()
        child.wait()


def ended_well(child: Process) -> bool:
    """Let it come to its end, and whether that was a good one."""
    child.terminate()
    return child.wait(LIFE_LIMIT_S) == 0


def answer(config: Config, process: str, key: str, payload: bytes = b"") -> bytes:
    """Return the process's answer, as soon as it answers."""
    deadline = time.monotonic() + LIFE_LIMIT_S
    while True:
        try:
            with client(getattr(config.tables.zenoh, process)) as bus:
                return bus.ask_one(key, payload)
        except BodyschemaError:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def status_when(
    config: Config, process: str, kind: type[S], true: Callable[[S], bool], limit_s: float = LIFE_LIMIT_S
) -> S:
    """Return the process's status as soon as `true` holds for it."""
    deadline = time.monotonic() + limit_s
    said = None
    while time.monotonic() < deadline:
        # One session for many questions: to open one costs more than both processes use meanwhile.
        with contextlib.suppress(BodyschemaError), client(getattr(config.tables.zenoh, process)) as bus:
            while time.monotonic() < deadline:
                said = decode(bus.ask_one(KEYS.status(process)), kind)
                if true(said):
                    return said
                time.sleep(0.05)
        time.sleep(0.05)
    raise AssertionError(said)


def learner_with(config: Config, pairs: int, limit_s: float = LIFE_LIMIT_S) -> LearnerStatus:
    """Return the learner's status as soon as it has at least `pairs` pairs."""
    return status_when(config, "learner", LearnerStatus, lambda status: status.last_seq >= pairs, limit_s)


def sampler_with(config: Config, pairs: int) -> SamplerStatus:
    """Return the sampler's status as soon as it has at least `pairs` pairs."""
    return status_when(config, "sampler", SamplerStatus, lambda status: status.pairs >= pairs)


def pause(config: Config) -> int:
    """Let the sampler accept no more pairs; how many there are."""
    answer(config, "sampler", KEYS.command("sampler"), encode(CommandRequest("pause")))
    return status_when(
        config, "sampler", SamplerStatus, lambda status: "paused" in status.rejected or status.state == "ended"
    ).pairs


def expect_each_pair_learnt_once(config: Config, limit_s: float = LIFE_LIMIT_S) -> LearnerStatus:
    """Stop the sampler's taking pairs: the learner then has all of them, and each once."""
    pairs = pause(config)
    status = learner_with(config, pairs, limit_s)
    assert (status.pairs, status.last_seq, status.refused) == (pairs, pairs, 0)
    return status
