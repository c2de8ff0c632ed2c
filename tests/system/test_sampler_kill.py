from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from sampler_killed_at import POINTS

from daemon.bus import Bus
from daemon.config import Config
from daemon.keys import Keys
from daemon.sampler import Sampler
from daemon.session import session_of
from daemon.store import PairReader, PairStore
from daemon.wire import PairMessage, PairsReply, decode, encode, pair_to_wire
from daemon.wiring import open_sources
from interfaces.clock import SystemClock
from interfaces.recording import Recording

LIMIT_S = 60.0
PAIRS = 40
KILL_AT = 17
# How many pairs are in the store when the process dies at the 17th pair.
STORED = {"at the commit": 16, "before the publication": 17, "after the publication": 17}
URDF = """<robot name="arm"><link name="base"/><link name="hand"/>
<joint name="waist" type="revolute"><parent link="base"/><child link="hand"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""
ROBOT = """[robot]
name = "arm"
urdf = "arm.urdf"
joints = ["waist"]
marker_link = "hand"
marker_xyz = [0.4, 0.0, 0.0]
[camera]
parent_link = "base"
[zenoh]
sampler = "{endpoint}"
[daemon]
state_dir = "state"
[drivers]
recording = "walk.csv"
speed = 0
"""


@pytest.fixture
def config(tmp_path: Path, endpoint: str) -> Config:
    """A robot whose sources are the recording of a walk of `PAIRS` steps."""
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "robot.toml").write_text(ROBOT.format(endpoint=endpoint))
    config = Config.load(tmp_path / "robot.toml", {})
    t = np.arange(PAIRS) / 30
    q = np.radians(2.0) * np.arange(PAIRS)[:, None]
    Recording(("waist",), q, config.robot.chain.positions(q), t).write_csv(tmp_path / "walk.csv")
    return config


def killed(config: Config, point: str) -> list[int]:
    """Kill a sampler at `point`; the sequence numbers it left in the store."""
    script = str(Path(__file__).with_name("sampler_killed_at.py"))
    command = [sys.executable, script, point, str(KILL_AT), "--robot", str(config.file)]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == -9, done.stderr
    with PairReader(config.store_file) as reader:
        return [pair.seq for pair in reader.read()]


@pytest.mark.parametrize("point", POINTS)
def test_a_sampler_killed_around_a_commit_leaves_exactly_the_committed_pairs(config, point) -> None:
    assert killed(config, point) == list(range(1, STORED[point] + 1))


@pytest.mark.parametrize("point", POINTS)
def test_a_sampler_started_after_a_kill_numbers_on_and_serves_every_pair(config, point) -> None:
    before = len(killed(config, point))
    with (
        PairStore(config.store_file, session_of(config, SystemClock())) as store,
        open_sources(config, sim=False) as sources,
        Bus(listen=config.tables.zenoh.sampler) as bus,
        Bus(connect=config.tables.zenoh.sampler, client=True) as asking,
    ):
        sampler = Sampler(config, sources, bus, store, exit_at_end=True)
        sampler.run()
        served = decode(asking.ask_one(Keys("arm").pairs), PairsReply)
        stored = [decode(encode(pair_to_wire(pair)), PairMessage) for pair in store.read()]
    assert served.pairs == stored
    assert [pair.seq for pair in served.pairs] == list(range(1, before + PAIRS + 1))
