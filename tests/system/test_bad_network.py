"""Sampler and learner with a bad network between them, and with clients that load them: no pair is lost or doubled."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bad_link import BadLink
from two_processes import (
    KEYS,
    LIFE_LIMIT_S,
    answer,
    expect_each_pair_learnt_once,
    learner_with,
    running,
    sampler_with,
    status_when,
    write_robot,
)

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.session import client
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import JointsRequest, encode
from bodyschema.interfaces.errors import BodyschemaError

SOME, MORE = 20, 60


def over(link: BadLink, config: Config) -> Config:
    """Return the configuration of a learner that reaches the sampler over the link."""
    text = config.file.read_text().replace(config.tables.zenoh.sampler, link.endpoint)
    file = config.file.with_name("far.toml")
    file.write_text(text)
    return Config.load(file, {})


@contextlib.contextmanager
def apart(folder: Path, free_endpoint) -> Iterator[tuple[Config, BadLink]]:
    """Run both processes with a link between them until some pairs are learned."""
    config = write_robot(folder, free_endpoint)
    with (
        BadLink(config.tables.zenoh.sampler) as link,
        running(config, "sampler"),
        running(over(link, config), "learner"),
    ):
        learner_with(config, SOME)
        yield config, link


def predicts(config: Config) -> None:
    answer(config, "learner", KEYS.predict, encode(JointsRequest([0.1, 0.2])))


def lose_each_other(config: Config, link: BadLink, pairs: int) -> None:
    """Block the link until the learner has noticed and the sampler has this many more pairs; then restore it."""
    link.part()
    noticed = status_when(config, "learner", LearnerStatus, lambda status: not status.sampler_alive)
    sampler_with(config, noticed.last_seq + pairs)
    predicts(config)
    link.meet()
    status_when(config, "learner", LearnerStatus, lambda status: status.sampler_alive)


def test_partition_loses_and_doubles_no_pair(tmp_path, free_endpoint) -> None:
    with apart(tmp_path, free_endpoint) as (config, link):
        lose_each_other(config, link, MORE)
        status = expect_each_pair_learnt_once(config)
    assert status.gaps_recovered >= MORE


@pytest.mark.soak
def test_learner_catches_up_thousands_after_long_partition(tmp_path, free_endpoint) -> None:
    with apart(tmp_path, free_endpoint) as (config, link):
        for pairs in (6000, 300, 300):
            lose_each_other(config, link, pairs)
        expect_each_pair_learnt_once(config)


@pytest.mark.soak
def test_repeated_disconnections_lose_no_pair(tmp_path, free_endpoint) -> None:
    with apart(tmp_path, free_endpoint) as (config, link):
        for _ in range(4):
            link.cut()
            sampler_with(config, sampler_with(config, 0).pairs + 10)
        expect_each_pair_learnt_once(config)


@pytest.mark.soak
def test_slow_network_delivers_every_pair(tmp_path, free_endpoint) -> None:
    with apart(tmp_path, free_endpoint) as (config, link):
        link.delay_s, link.bytes_per_s = 0.4, 40_000
        learner_with(config, sampler_with(config, 0).pairs + MORE)
        expect_each_pair_learnt_once(config)


@pytest.mark.soak
def test_learner_catches_up_after_absence(tmp_path, free_endpoint) -> None:
    config = write_robot(tmp_path, free_endpoint)
    with running(config, "sampler"):
        with running(config, "learner"):
            learner_with(config, SOME)
        sampler_with(config, SOME + MORE)
        with running(config, "learner"):
            expect_each_pair_learnt_once(config)


def in_a_namespace(how: str, folder: Path, pairs: int) -> int:
    """Count the pairs accepted, and learned once each, by processes whose kernel degrades the network."""
    if subprocess.run(["unshare", "--net", "true"], capture_output=True, check=False).returncode:
        pytest.skip("no network namespaces; to run it: be root")
    script = Path(__file__).with_name("kernel_network.py")
    command = ["unshare", "--net", sys.executable, script, how, folder, str(pairs)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if "qdisc kind is unknown" in done.stderr:
        pytest.skip("this kernel has no tbf; to run it: modprobe sch_tbf")
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


@pytest.mark.soak
@pytest.mark.parametrize(("how", "pairs"), [("down", 200), ("down", 6000), ("slow", 300)])
def test_long_outage_or_slow_link_loses_no_pair(tmp_path, how, pairs) -> None:
    assert in_a_namespace(how, tmp_path, pairs) > pairs


SUBSCRIBER = """
import sys, time, zenoh
from bodyschema.daemon.transport.session import ZenohSession
with ZenohSession(connect=sys.argv[1]) as bus:
    bus.subscribe(sys.argv[2], lambda payload: (print("heard", flush=True), time.sleep(3600)))
    time.sleep(3600)
"""


@pytest.mark.soak  # with bare sessions: tests/daemon/test_zenoh_session.py
@pytest.mark.parametrize("stopped", [False, True], ids=["slow", "stopped"])
def test_a_subscriber_that_takes_nothing_delays_nobody_else(tmp_path, free_endpoint, stopped) -> None:
    config = write_robot(tmp_path, free_endpoint)
    with running(config, "sampler"), running(config, "learner"):
        learner_with(config, SOME)
        command = [sys.executable, "-c", SUBSCRIBER, config.tables.zenoh.sampler, KEYS.pair]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as subscriber:
            try:
                assert subscriber.stdout is not None
                assert subscriber.stdout.readline() == b"heard\n"
                if stopped:
                    os.kill(subscriber.pid, signal.SIGSTOP)
                sampler_with(config, sampler_with(config, 0).pairs + 5 * MORE)
                learner_with(config, sampler_with(config, 0).pairs)
                expect_each_pair_learnt_once(config)
            finally:
                subscriber.kill()


class Flood:
    """Clients that each ask for the largest batch allowed as soon as the last one was answered."""

    def __init__(self, config: Config, clients: int) -> None:
        self._config, self._end = config, threading.Event()
        self._threads = [threading.Thread(target=self._ask) for _ in range(clients)]
        self._lock, self.answered = threading.Lock(), 0

    def __enter__(self) -> Flood:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._end.set()
        for thread in self._threads:
            thread.join(LIFE_LIMIT_S)

    def _ask(self) -> None:
        batch = encode(JointsRequest(np.random.default_rng(0).uniform(-1, 1, (2000, 2)).tolist()))
        with client(self._config.tables.zenoh.learner) as bus:
            while not self._end.is_set():
                with contextlib.suppress(BodyschemaError):  # refused, or not in time: that is the learner's right
                    bus.ask_one(KEYS.predict, batch)
                    with self._lock:
                        self.answered += 1


@pytest.mark.soak
def test_query_flood_does_not_stop_learning(tmp_path, free_endpoint) -> None:
    config = write_robot(tmp_path, free_endpoint)
    with running(config, "sampler"), running(config, "learner"):
        begun = learner_with(config, SOME).last_seq
        with Flood(config, 4) as flood:
            learner_with(config, begun + MORE)
            assert flood.answered > 0
        assert expect_each_pair_learnt_once(config).health == []
