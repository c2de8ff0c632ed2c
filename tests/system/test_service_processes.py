"""A real sampler and a real learner under a stand-in for systemd."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest
import warm
from security_recipe import SEVERAL, carried_out
from stalled_at import WORK
from two_processes import KEYS, write_robot

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner import learner
from bodyschema.daemon.sampler import sampler
from bodyschema.daemon.transport.session import client
from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import PairsReply, decode
from bodyschema.recordings.store.store import PairReader

LIMIT_S = 500.0
WATCHDOG_S = 0.8
PAIRS_PER_S = 24.0
STARVED_S = 2 * WATCHDOG_S
LOOPS = {"sampler": sampler.LOOPS, "learner": learner.LOOPS}


class Systemd:
    """The listening half of sd_notify(3)."""

    def __init__(self, file: Path) -> None:
        self.file, self.heard = file, []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(file))

    def hear(self, limit_s: float) -> str | None:
        """Return the next notification, or None if none comes in time."""
        self._socket.settimeout(limit_s)
        try:
            said = self._socket.recv(4096).decode()
        except TimeoutError:
            return None
        self.heard.append(said)
        return said

    def wait_for(self, words: str) -> str:
        deadline = time.monotonic() + LIMIT_S
        while time.monotonic() < deadline:
            said = self.hear(deadline - time.monotonic())
            if said is not None and words in said:
                return said
        raise AssertionError(f"{words} was never said, but {self.heard}")

    def is_starved(self) -> bool:
        """Return True if the watchdog, once fed, is not fed for longer than systemd waits."""
        deadline = time.monotonic() + LIMIT_S
        fed_at = time.monotonic()
        while time.monotonic() < deadline:
            if self.hear(STARVED_S / 4) == "WATCHDOG=1":
                fed_at = time.monotonic()
            elif time.monotonic() - fed_at > STARVED_S:
                return True
        return False

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[Systemd]:
    listening = Systemd(tmp_path / "notify")
    yield listening
    listening.close()


@pytest.fixture
def config(tmp_path: Path, free_endpoint: Callable[[], str]) -> Config:
    return write_robot(tmp_path, free_endpoint, rows=round(PAIRS_PER_S * LIMIT_S), pairs_per_s=PAIRS_PER_S)


def started(
    config: Config, systemd: Systemd, process: str, *wrapper: object
) -> contextlib.AbstractContextManager[warm.Child]:
    """Run a process under `systemd`, with its log beside robot.toml."""
    return running(systemd, log_of(config), *(wrapper or ("-m", "bodyschema")), "run", process, "--robot", config.file)


@contextlib.contextmanager
def running(systemd: Systemd, log_file: Path, *arguments: object) -> Iterator[warm.Child]:
    """Run Python with these arguments under `systemd`."""
    environment = os.environ | {"NOTIFY_SOCKET": str(systemd.file), "WATCHDOG_USEC": str(round(1e6 * WATCHDOG_S))}
    with log_file.open("ab") as log:
        child = warm.Child(*arguments, stderr=log, env=environment)
    try:
        yield child
    finally:
        child.kill()
        child.wait()


def log_of(config: Config) -> Path:
    return config.file.with_name("log")


def test_router_is_ready_when_it_accepts_connections(
    tmp_path: Path, systemd: Systemd, free_endpoint: Callable[[], str]
) -> None:
    pki, port = carried_out(tmp_path), free_endpoint().rpartition(":")[2]
    file = pki / "router.toml"
    file.write_text((SEVERAL / "router.toml").read_text().replace("tls/192.0.2.10:7450", f"tls/127.0.0.1:{port}"))
    with running(systemd, tmp_path / "log", "-m", "bodyschema", "router", file) as router:
        systemd.wait_for("READY=1")
        with socket.create_connection(("127.0.0.1", int(port)), timeout=LIMIT_S):
            systemd.wait_for("WATCHDOG=1")
        router.send_signal(signal.SIGTERM)
        systemd.wait_for("STOPPING=1")
        assert router.wait(LIMIT_S) == 0


def test_sampler_is_ready_when_reading_storing_answering(config: Config, systemd: Systemd) -> None:
    with started(config, systemd, "sampler"):
        systemd.wait_for("READY=1")
        with client(config.tables.zenoh.sampler) as bus:
            status = decode(bus.ask_one(KEYS.status("sampler")), SamplerStatus)
        assert (status.frames > 0, status.state, status.health) == (True, "running", [])
        assert config.store_file.exists()
        assert systemd.heard[0] == "STATUS=opening encoders and cameras"


def test_sampler_without_store_is_never_ready(config: Config, systemd: Systemd) -> None:
    config.state_dir.write_text("no folder")
    with started(config, systemd, "sampler") as child:
        assert child.wait(LIMIT_S) == 1
    while systemd.hear(0.01) is not None:
        pass
    assert "READY=1" not in systemd.heard


def test_sampler_with_taken_port_is_never_ready(config: Config, systemd: Systemd) -> None:
    host, _, port = config.tables.zenoh.sampler.removeprefix("tcp/").rpartition(":")
    with socket.create_server((host, int(port))), started(config, systemd, "sampler") as child:
        assert child.wait(LIMIT_S) == 1
    while systemd.hear(0.01) is not None:
        pass
    assert "READY=1" not in systemd.heard


def test_learner_is_ready_when_it_answers(config: Config, systemd: Systemd) -> None:
    with started(config, systemd, "learner") as child:
        systemd.wait_for("READY=1")
        with client(config.tables.zenoh.learner) as bus:
            assert decode(bus.ask_one(KEYS.status("learner")), LearnerStatus).state == "waiting"
        assert "STATUS=waiting, 0 samples, prior answers. no sampler on" in systemd.wait_for("STATUS=waiting")
        child.terminate()
        systemd.wait_for("STOPPING=1")
        assert child.wait(LIMIT_S) == 0


@pytest.mark.parametrize("process", LOOPS)
def test_each_loop_that_hangs_starves_the_watchdog_alone(config: Config, systemd: Systemd, process: str) -> None:
    wrapper = (Path(__file__).with_name("stalled_at.py"), config.file.parent)
    with started(config, systemd, process, *wrapper):
        systemd.wait_for("READY=1")
        for loop in LOOPS[process]:
            systemd.wait_for("WATCHDOG=1")
            hang = config.file.with_name(loop)
            hang.touch()
            assert systemd.is_starved(), loop
            hang.unlink()
        systemd.wait_for("WATCHDOG=1")


def test_every_loop_that_can_hang_is_watched() -> None:
    assert {loop for loops in LOOPS.values() for loop in loops} == set(WORK)


def pairs_of(config: Config) -> PairsReply:
    with client(config.tables.zenoh.sampler) as bus:
        return decode(bus.ask_one(KEYS.pairs), PairsReply)


def test_reload_of_robot_toml_loses_no_frame(config: Config, systemd: Systemd) -> None:
    text = config.file.read_text()
    with started(config, systemd, "sampler") as child:
        systemd.wait_for("READY=1")
        config.file.write_text(text.replace("any_step = true", "any_step = true\nmax_reading_gap_s = 7.0"))
        child.send_signal(signal.SIGHUP)
        systemd.wait_for("RELOADING=1")
        systemd.wait_for("READY=1")
        enough = pairs_of(config).last_seq + 20
        while pairs_of(config).last_seq < enough:
            time.sleep(0.05)
        child.terminate()
        assert child.wait(LIMIT_S) == 0
    assert "in force now: daemon.max_reading_gap_s = 7.0" in log_of(config).read_text()
    with PairReader(config.store_file) as store:
        t = [pair.t for pair in store.read()]
    assert max(b - a for a, b in pairwise(t)) < 1.5 / PAIRS_PER_S  # every frame of the recording


def test_sampler_survives_wrong_robot_toml_on_reload(config: Config, systemd: Systemd) -> None:
    with started(config, systemd, "sampler") as child:
        systemd.wait_for("READY=1")
        config.file.write_text(config.file.read_text().replace("any_step = true", "any_stop = true"))
        child.send_signal(signal.SIGHUP)
        systemd.wait_for("RELOADING=1")
        systemd.wait_for("READY=1")
        pairs = pairs_of(config).last_seq
        while pairs_of(config).last_seq == pairs:
            time.sleep(0.05)
    assert "robot.toml was read again and is not followed" in log_of(config).read_text()
