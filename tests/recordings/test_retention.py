"""Deletion of old pairs from a store, and its consequences for readers."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from bodyschema.daemon.sampler.history import answer_pairs
from bodyschema.daemon.transport.session import Request
from bodyschema.daemon.transport.wire import JSON, PairsReply, decode
from bodyschema.interfaces.records import MarkerFix, frozen_array
from bodyschema.recordings.store.retention import AT_ONCE, Keep, used_bytes
from bodyschema.recordings.store.store import PairReader, PairStore, Session

NOW = "2026-11-21T12:00:00.000+00:00"
SESSION = Session(("waist", "shoulder"), NOW, "[robot]", "<robot/>", "{}", "0", "host")
COV = frozen_array(np.eye(3) * 1e-6)
SERVO = {"joint": "waist", "model": "XM430-W350"}
EVERYTHING = Keep(None, None, 1)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "pairs.sqlite"


@pytest.fixture
def store(file: Path) -> Iterator[PairStore]:
    with PairStore(file, SESSION) as store:
        store._connection.execute("PRAGMA synchronous = OFF")  # nothing here is about power cuts
        yield store


def days_ago(days: float) -> str:
    return (datetime.fromisoformat(NOW) - timedelta(days=days)).isoformat(timespec="milliseconds")


def fill(store: PairStore, ages: list[float]) -> None:
    """Store one pair of each age [days]."""
    for age in ages:
        fix = MarkerFix(0.0, frozen_array([0.1, 0.2, 1.0]), COV, (1.0, 2.0, 3.0, 4.5))
        store.append(1, days_ago(age), frozen_array([0.1, -0.1]), fix)


def left(store: PairStore) -> list[int]:
    return [pair.seq for pair in store.read()]


def trim(store: PairStore, keep: Keep) -> int:
    """Let go all that is to go."""
    total = 0
    while deleted := store.trim(keep, NOW):
        total += deleted
    return total


def test_without_limits_everything_is_kept(store) -> None:
    fill(store, [900.0, 1.0])
    assert trim(store, EVERYTHING) == 0
    assert left(store) == [1, 2]


def test_pairs_older_than_the_limit_are_deleted(store) -> None:
    fill(store, [40.0, 31.0, 29.0, 1.0])
    assert trim(store, Keep(30.0, None, 1)) == 2
    assert left(store) == [3, 4]


def test_the_newest_stay_however_old_they_are(store) -> None:
    fill(store, [40.0] * 10)
    trim(store, Keep(30.0, None, 4))
    assert left(store) == [7, 8, 9, 10]


def test_forward_clock_jump_keeps_the_newest_pairs(store) -> None:
    fill(store, [0.0] * 10)
    store.trim(Keep(30.0, None, 4), days_ago(-3650))
    assert left(store) == [7, 8, 9, 10]


def test_old_pair_is_kept_behind_a_newer_one(store) -> None:
    fill(store, [40.0, 1.0, 40.0, 1.0])
    trim(store, Keep(30.0, None, 1))
    assert left(store) == [2, 3, 4]


def test_no_pair_waits_long_while_others_are_deleted(store) -> None:
    fill(store, [40.0] * (AT_ONCE + 20))
    assert store.trim(Keep(30.0, None, 1), NOW) == AT_ONCE


def test_store_size_stays_within_its_limit(store, file) -> None:
    keep = Keep(None, 80_000.0, 50)
    for _ in range(12):
        fill(store, [0.0] * 60)
        store.trim(keep, NOW)
    assert used_bytes(store._connection) <= keep.size
    assert file.stat().st_size < 2 * keep.size
    assert left(store)[-1] == 720


def test_numbers_go_on_and_are_never_given_twice(store, file) -> None:
    fill(store, [40.0] * 10)
    trim(store, Keep(30.0, None, 1))
    fill(store, [0.0])
    assert left(store) == [10, 11]


def test_a_store_that_let_pairs_go_opens_again(file) -> None:
    with PairStore(file, SESSION) as store:
        fill(store, [40.0] * 10)
        trim(store, Keep(30.0, None, 3))
    with PairStore(file, SESSION) as store:
        fill(store, [0.0])
        assert left(store) == [8, 9, 10, 11]


def test_device_records_of_remaining_pairs_are_kept(file) -> None:
    for model in ("XM430-W350", "XM540-W270"):
        with PairStore(file, SESSION) as store:
            store.note_devices(NOW, [SERVO | {"model": model}])
            fill(store, [40.0] * 5)
    with PairStore(file, SESSION) as store:
        trim(store, Keep(30.0, None, 2))
        assert [(devices.from_seq, devices.record[0]["model"]) for devices in store.reader.devices()] == [
            (6, "XM540-W270")
        ]


def test_sessions_without_pairs_are_deleted(file) -> None:
    for _ in range(4):
        with PairStore(file, SESSION) as store:
            fill(store, [40.0] * 5)
    with PairStore(file, SESSION) as store:
        trim(store, Keep(30.0, None, 2))
        assert store._connection.execute("SELECT count(*) FROM sessions").fetchone()[0] == 2


def test_history_begins_with_the_oldest_remaining_pair(store, file) -> None:
    fill(store, [40.0] * 10)
    trim(store, Keep(30.0, None, 4))
    with PairReader(file) as reader:
        reply = decode(answer_pairs(reader, Request({"from": "2"}, b"", JSON)), PairsReply)
    assert ([pair.seq for pair in reply.pairs], reply.last_seq) == ([7, 8, 9, 10], 10)
