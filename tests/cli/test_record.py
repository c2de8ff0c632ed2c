from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_arm import JOINTS, write_small_arm

from bodyschema.cli.main import app
from bodyschema.cli.recordings.recorder import History, follow_history
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import Request, ZenohSession, client
from bodyschema.daemon.transport.wire import PairsReply, encode, pair_to_wire
from bodyschema.interfaces.errors import BusError, RecordingError
from bodyschema.interfaces.records import Pair
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

PAGE = 2


def pair(seq: int, store: str = "one") -> Pair:
    rng = np.random.default_rng(seq)
    return Pair(store, seq, 1, float(seq), "utc", rng.normal(size=2), rng.normal(size=3), np.eye(3) * 1e-6)


def robot_in(folder: Path) -> RobotDescription:
    return RobotDescription.load(folder / "robot.toml")


class FakeSampler:
    """A fake sampler that serves `pairs`, a page at a time."""

    def __init__(self, bus: ZenohSession) -> None:
        self.pairs: list[Pair] = []
        self.store = "one"
        bus.answer(Keys("arm").pairs, self._answer)
        self.publish = bus.publisher(Keys("arm").pair)

    def _answer(self, request: Request) -> bytes:
        first = int(request.parameters["from"])
        page = [pair_to_wire(pair) for pair in self.pairs if pair.seq >= first][:PAGE]
        return encode(PairsReply(self.store, len(self.pairs), page))


@pytest.fixture
def robot(tmp_path: Path, endpoint: str) -> Path:
    return write_small_arm(tmp_path, f'[zenoh]\nsampler = "{endpoint}"\n')


@pytest.fixture
def sampler(endpoint: str) -> Iterator[FakeSampler]:
    with ZenohSession(listen=endpoint) as bus:
        yield FakeSampler(bus)


@pytest.fixture
def history(sampler: FakeSampler, robot: Path, endpoint: str) -> Iterator[History]:
    with client(endpoint) as bus:
        yield History(bus, RobotDescription.load(robot), 1)


def record(*arguments: object) -> None:
    app(["record", *map(str, arguments)], result_action="return_value")


def test_missing_pair_numbers_are_reported(sampler, robot, tmp_path, capsys) -> None:
    sampler.pairs = [pair(seq) for seq in (3, 4, 7, 8, 10)]
    record(tmp_path / "a.csv", "--robot", robot)
    assert "3 samples between them are missing (numbers 5 to 6, 9)" in capsys.readouterr().out


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_all_pages_of_the_history_are_copied_exactly(sampler, robot, tmp_path, ending, capsys) -> None:
    pytest.importorskip("pyarrow")
    sampler.pairs = [pair(seq) for seq in range(1, 6)]
    record(tmp_path / f"a.{ending}", "--robot", robot)
    recording = Recording.read(tmp_path / f"a.{ending}", JOINTS)
    assert recording.q.tolist() == [pair.q.tolist() for pair in sampler.pairs]
    assert recording.cov is not None
    assert recording.cov.tolist() == [pair.cov.tolist() for pair in sampler.pairs]
    assert "number 5" in capsys.readouterr().out


def test_copying_begins_at_the_requested_pair(sampler: FakeSampler, robot: Path, tmp_path: Path) -> None:
    sampler.pairs = [pair(seq) for seq in range(1, 6)]
    record(tmp_path / "a.csv", "--robot", robot, "--from", 4)
    recording = Recording.read(tmp_path / "a.csv", JOINTS)
    assert recording.t is not None
    assert recording.t.tolist() == [4.0, 5.0]


def test_without_pairs_no_file_is_left(sampler: FakeSampler, robot: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no samples from number 1"):
        record(tmp_path / "a.csv", "--robot", robot)
    assert not (tmp_path / "a.csv").exists()


def test_without_a_sampler_the_remedy_is_named(robot: Path, tmp_path: Path) -> None:
    with pytest.raises(BusError, match="bodyschema run"):
        record(tmp_path / "a.csv", "--robot", robot)
    assert not (tmp_path / "a.csv").exists()


@pytest.mark.parametrize("ending", ["csv", "parquet", "mcap"])
def test_following_writes_what_comes_until_it_is_stopped(history, sampler, tmp_path, ending) -> None:
    pytest.importorskip("pyarrow")
    sampler.pairs = [pair(1)]

    def stopped() -> bool:
        """Accept one more pair per call; return True when the recording should stop."""
        if len(sampler.pairs) < 6:
            sampler.pairs.append(pair(len(sampler.pairs) + 1))
            sampler.publish(b"")
        return history.next_seq > 6

    out = tmp_path / f"a.{ending}"
    assert follow_history(history, robot_in(tmp_path), out, stopped) == 6
    if ending != "mcap":
        assert Recording.read(out, JOINTS).q.tolist() == [pair.q.tolist() for pair in sampler.pairs]


def test_following_csv_leaves_whole_lines_at_any_moment(history, sampler, tmp_path) -> None:
    sampler.pairs = [pair(seq) for seq in range(1, 6)]
    seen: list[int] = []

    def stopped() -> bool:
        if history.next_seq > 1:
            seen.append(len(Recording.read(tmp_path / "a.csv", JOINTS)))
        return history.next_seq > 5

    follow_history(history, robot_in(tmp_path), tmp_path / "a.csv", stopped)
    assert seen == [2, 4, 5]


def turned(seq: int) -> Pair:
    return replace(pair(seq), R=np.array([0.0, 0.6, 0.0, 0.8]))


def test_orientations_are_copied_where_every_pair_has_one(sampler, robot, tmp_path) -> None:
    sampler.pairs = [turned(seq) for seq in range(1, 4)]
    record(tmp_path / "a.csv", "--robot", robot)
    orientation = Recording.read(tmp_path / "a.csv", JOINTS).orientation
    assert orientation is not None
    assert orientation.tolist() == [[0.0, 0.6, 0.0, 0.8]] * 3


def test_following_csv_ends_where_orientations_begin(history, sampler, tmp_path) -> None:
    sampler.pairs = [pair(1), pair(2), turned(3), turned(4)]
    with pytest.raises(
        RecordingError, match=r"from sample 3 to 4 some have a marker orientation and some do not. The 2 rows so far"
    ):
        follow_history(history, robot_in(tmp_path), tmp_path / "a.csv", lambda: history.next_seq > 4)
    assert len(Recording.read(tmp_path / "a.csv", JOINTS)) == 2


def test_following_without_any_pair_leaves_no_file(history: History, tmp_path: Path) -> None:
    assert follow_history(history, robot_in(tmp_path), tmp_path / "a.csv", lambda: True) == 0
    assert not (tmp_path / "a.csv").exists()


def test_another_store_is_not_mixed_in(history: History, sampler: FakeSampler, tmp_path: Path) -> None:
    sampler.pairs = [pair(1)]
    history.page()
    sampler.store = "other"
    with pytest.raises(RecordingError, match="another store"):
        history.page()


def test_followed_recording_ends_cleanly_on_sigint(sampler: FakeSampler, robot: Path, tmp_path: Path) -> None:
    sampler.pairs = [pair(1)]
    command = [sys.executable, "-m", "bodyschema", "record", str(tmp_path / "a.csv"), "--robot", str(robot), "--follow"]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        assert "Ctrl-C" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert "written to" in process.stdout.read()
        assert process.wait() == 0
