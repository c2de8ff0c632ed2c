from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from daemon.bus import Bus, client
from daemon.config import Config
from daemon.keys import Keys
from daemon.status import LearnerStatus, SamplerStatus
from daemon.store import PairReader
from daemon.wire import CommandRequest, PairMessage, decode, encode
from interfaces.errors import BodyschemaError

WRAPPER = Path(__file__).with_name("killed_at.py")
SAMPLER_POINTS = ("before the commit", "between commit and publication", "after the publication")
LEARNER_POINTS = (
    "in the middle of a checkpoint",
    "before the checkpoint's rename",
    "after the checkpoint's rename",
)
PAIRS_PER_S = 60.0
LIFE_LIMIT_S = 60.0
URDF = """<robot name="arm"><link name="base"/><link name="upper"/><link name="hand"/>
<joint name="waist" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="shoulder" type="revolute"><parent link="upper"/><child link="hand"/><origin xyz="0.3 0 0"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""
ROBOT = """[robot]
name = "arm"
urdf = "arm.urdf"
joints = ["waist", "shoulder"]
marker_link = "hand"
marker_xyz = [0.2, 0.0, 0.0]
[camera]
parent_link = "base"
[zenoh]
sampler = "tcp/127.0.0.1:{sampler}"
learner = "tcp/127.0.0.1:{learner}"
[drivers]
recording = "walk.csv"
[daemon]
state_dir = "state"
any_step = true
[learner]
checkpoint_every_s = 0.2
"""


@dataclass(frozen=True)
class Kill:
    """How one life of a process ends: at the nth time of a named point, or so long after its start [s]."""

    point: str | None
    nth: int
    after_s: float


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def write_robot(folder: Path) -> Config:
    """A robot whose encoders and camera are a recording of a long walk."""
    (folder / "arm.urdf").write_text(URDF)
    robot_file = folder / "robot.toml"
    robot_file.write_text(ROBOT.format(sampler=free_port(), learner=free_port()))
    config = Config.load(robot_file)
    t = np.arange(60_000) / PAIRS_PER_S
    q = np.stack([1.5 * np.sin(0.3 * t), 1.2 * np.sin(0.17 * t + 1.0)], axis=1)
    x = config.robot.chain.with_tool([0.03, 0.01, -0.02]).positions(q)
    rows = np.column_stack([t, q, x])
    np.savetxt(folder / "walk.csv", rows, delimiter=",", header="t,waist,shoulder,x,y,z", comments="", fmt="%.9f")
    return config


def plan(rng: np.random.Generator, points: tuple[str, ...], kills: int, largest: int) -> list[Kill]:
    """Kills at the named points in turn, every third one at a random moment instead."""
    return [
        Kill(
            None if k % 3 == 2 else points[(k - k // 3) % len(points)],
            int(rng.integers(1, largest)),
            rng.uniform(0.3, 2.5),
        )
        for k in range(kills)
    ]


@contextlib.contextmanager
def running(config: Config, process: str, kill: Kill | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """A process of ours, doomed when there is a `kill`; it is gone after the with statement."""
    doomed = [str(WRAPPER), kill.point, str(kill.nth)] if kill and kill.point else ["-m", "daemon"]
    command = [sys.executable, *doomed, process, "--robot", str(config.file)]
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


def live_and_die(config: Config, process: str, kills: list[Kill], deaths: list[str]) -> None:
    """One doomed life of a process after the other."""
    for kill in kills:
        with running(config, process, kill) as child:
            if kill.point is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.wait(kill.after_s)
                deaths.append("random" if child.poll() is None else "died by itself")
                continue
            try:
                code = child.wait(LIFE_LIMIT_S)
                deaths.append(kill.point if code == -9 else f"ended with {code}")
            except subprocess.TimeoutExpired:
                deaths.append(f"never came to {kill.point}")


def wait_until(done: Callable[[], bool], limit_s: float = 60.0) -> None:
    end = time.monotonic() + limit_s
    while not done():
        assert time.monotonic() < end, "not in time"
        time.sleep(0.1)


def learner_status(config: Config) -> LearnerStatus | None:
    try:
        with client(config.tables.zenoh.learner) as bus:
            return decode(bus.ask_one(Keys(config.robot.name).status("learner")), LearnerStatus)
    except BodyschemaError:
        return None


def pause_sampler(config: Config) -> int:
    """Let the sampler accept no more pairs; how many it has."""
    keys = Keys(config.robot.name)
    with client(config.tables.zenoh.sampler) as bus:
        bus.ask_one(keys.command("sampler"), encode(CommandRequest("pause")))
        before = -1
        while (pairs := decode(bus.ask_one(keys.status("sampler")), SamplerStatus).pairs) != before:
            before = pairs
            time.sleep(0.2)
    return pairs


def sampler_answers(config: Config) -> bool:
    try:
        with client(config.tables.zenoh.sampler) as bus:
            return bus.alive(Keys(config.robot.name).alive("sampler"))
    except BodyschemaError:
        return False


@dataclass(frozen=True)
class Aftermath:
    """What is left when all kills are over and the learner had time to catch up."""

    deaths: list[str]
    published: list[int]
    stored: list[int]
    learner: LearnerStatus


def kill_again_and_again(folder: Path, kills: int, seed: int) -> Aftermath:
    """Run both processes, kill each of them `kills` / 2 times, and see what is left in the end."""
    config, rng = write_robot(folder), np.random.default_rng(seed)
    deaths: list[str] = []
    published: list[int] = []
    lanes = [
        ("sampler", plan(rng, SAMPLER_POINTS, kills // 2, 60)),
        ("learner", plan(rng, LEARNER_POINTS, kills - kills // 2, 4)),
    ]
    threads = [threading.Thread(target=live_and_die, args=(config, name, doom, deaths)) for name, doom in lanes]
    with Bus(connect=config.tables.zenoh.sampler) as witness:
        witness.subscribe(Keys("arm").pair, lambda payload: published.append(decode(payload, PairMessage).seq))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        with running(config, "sampler"), running(config, "learner"):
            wait_until(lambda: sampler_answers(config))
            pairs = pause_sampler(config)
            wait_until(lambda: (status := learner_status(config)) is not None and status.last_seq >= pairs)
            learner = learner_status(config)
    assert learner is not None
    with PairReader(config.store_file) as store:
        stored = [pair.seq for pair in store.read()]
    return Aftermath(deaths, published, stored, learner)


@pytest.fixture(scope="module")
def aftermath(tmp_path_factory: pytest.TempPathFactory) -> Aftermath:
    return kill_again_and_again(tmp_path_factory.mktemp("kill"), kills=20, seed=0)


def expect_nothing_lost(aftermath: Aftermath) -> None:
    stored, learner = aftermath.stored, aftermath.learner
    assert stored == list(range(1, len(stored) + 1))
    assert set(aftermath.published) <= set(stored)
    assert (learner.pairs, learner.last_seq, learner.refused) == (len(stored), len(stored), 0)


def test_every_kill_came_where_it_was_planned(aftermath: Aftermath) -> None:
    assert set(aftermath.deaths) == {*SAMPLER_POINTS, *LEARNER_POINTS, "random"}
    assert len(aftermath.deaths) == 20


def test_a_killed_sampler_loses_no_accepted_pair(aftermath: Aftermath) -> None:
    assert aftermath.stored == list(range(1, len(aftermath.stored) + 1))
    assert set(aftermath.published) <= set(aftermath.stored)


def test_a_killed_learner_learns_every_accepted_pair_once(aftermath: Aftermath) -> None:
    learner, count = aftermath.learner, len(aftermath.stored)
    assert (learner.pairs, learner.last_seq, learner.refused) == (count, count, 0)


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [1, 2])
def test_two_hundred_kills_lose_nothing(tmp_path: Path, seed: int) -> None:
    aftermath = kill_again_and_again(tmp_path, kills=200, seed=seed)
    assert len(aftermath.deaths) == 200
    expect_nothing_lost(aftermath)
