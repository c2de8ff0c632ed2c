"""Invalid pairs, on the wire and in the store, with a real learner."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator

import numpy as np
import pytest
from two_processes import KEYS, LIFE_LIMIT_S, answer, learner_with, running, status_when, write_robot

from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.sampler.history import answer_pairs
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import JointsRequest, PredictReply, decode, encode, pair_to_wire
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.records import MarkerFix, frozen_array
from bodyschema.recordings.store import schema as store_schema
from bodyschema.recordings.store.rows import COLUMNS, checksum
from bodyschema.recordings.store.store import PairReader, PairStore
from kbmaps import RigidChain

PAIRS, SPOILT = 60, 30


@pytest.fixture
def config(tmp_path, free_endpoint) -> Config:
    """Return a robot with a store of pairs, and no process."""
    config = write_robot(tmp_path, free_endpoint, rows=PAIRS)
    t = np.arange(PAIRS) / 10.0
    q = np.stack([1.5 * np.sin(0.3 * t), 1.2 * np.sin(0.17 * t + 1.0)], axis=1)
    x, cov = built(config).positions(q), frozen_array(1e-6 * np.eye(3))
    with PairStore(config.store_file, session_of(config, SystemClock())) as store:
        for number in range(PAIRS):
            fix = MarkerFix(float(t[number]), frozen_array(x[number]), cov)
            store.append(1, "2026-11-22T12:00:00.000+00:00", frozen_array(q[number]), fix)
    return config


def built(config: Config) -> RigidChain:
    """Return the arm as built: with a marker position that differs from robot.toml."""
    return config.robot.chain.with_tool([0.03, 0.01, -0.02])


def spoil(config: Config, column: str, numbers: str) -> None:
    """Put numbers into a row as a faulty sampler would: with the checksum that goes with them."""
    with contextlib.closing(store_schema.connect(config.store_file)) as connection:
        connection.execute(f"UPDATE pairs SET {column} = ? WHERE seq = ?", (numbers, SPOILT))
        row = connection.execute(f"SELECT {COLUMNS['pairs']} FROM pairs WHERE seq = ?", (SPOILT,)).fetchone()
        connection.execute("UPDATE pairs SET checksum = ? WHERE seq = ?", (checksum(row), SPOILT))


@contextlib.contextmanager
def history(config: Config) -> Iterator[ZenohSession]:
    """Yield the remains of a sampler: it serves the store and publishes what it is given."""
    with ZenohSession(listen=config.tables.zenoh.sampler) as bus, PairReader(config.store_file) as store:
        bus.answer(KEYS.pairs, lambda request: answer_pairs(store, request))
        bus.token(KEYS.alive("sampler"))
        yield bus


def expect_numbers(config: Config, pairs: int) -> None:
    """Assert that the learner answers at once, and in time to 2 cm, where the nominal model is 4 cm off."""
    q = [[0.1, 0.9], [0.5, 1.0], [-0.3, 0.8]]
    truth, deadline = built(config).positions(np.array(q)), time.monotonic() + LIFE_LIMIT_S
    while True:
        reply = decode(answer(config, "learner", KEYS.predict, encode(JointsRequest(q))), PredictReply)
        assert reply.pairs == pairs
        assert np.isfinite(reply.sigma).all()
        off_m = float(np.linalg.norm(np.array(reply.x) - truth, axis=1).max())
        assert np.isfinite(off_m)
        if off_m < 0.02:
            return
        assert time.monotonic() < deadline, off_m
        time.sleep(0.05)


def test_impossible_stored_pair_is_refused(config) -> None:
    spoil(config, "cov", "[1e300,0,0,1e300,0,1e300]")
    with history(config), running(config, "learner"):
        status = learner_with(config, PAIRS)
        expect_numbers(config, PAIRS - 1)
    assert (status.pairs, status.refused) == (PAIRS - 1, 1)
    assert any(f"sample {SPOILT} says that it may be 1e+150 m wrong" in text for text in status.health)


def test_malformed_stored_row_is_skipped(config) -> None:
    spoil(config, "x", "[null,0.2,1.0]")
    with history(config), running(config, "learner"):
        status = learner_with(config, PAIRS)
        expect_numbers(config, PAIRS - 1)
    assert (status.pairs, status.missed, status.refused) == (PAIRS - 1, 1, 0)


def test_stored_pair_ten_metres_off_is_outlier(config) -> None:
    spoil(config, "x", "[10.0,10.0,10.0]")
    with history(config), running(config, "learner"):
        status = learner_with(config, PAIRS)
        expect_numbers(config, PAIRS)
    assert status.doubted >= 1


def test_poisoned_messages_are_refused_and_valid_learnt(config) -> None:
    with PairReader(config.store_file) as store:
        pair = json.loads(encode(pair_to_wire(store.read(PAIRS)[0])))
    poison = [{**pair, "seq": PAIRS + 1, **wrong} for wrong in ({"x": [None, 0, 1]}, {"q": [1e300, 0.0]})]
    with history(config) as bus, running(config, "learner"):
        learner_with(config, PAIRS)
        publish = bus.publisher(KEYS.pair)
        for number, each in enumerate(poison, 1):
            publish(json.dumps(each).encode())
            status_when(config, "learner", LearnerStatus, lambda status, number=number: status.refused >= number)
        expect_numbers(config, PAIRS)
