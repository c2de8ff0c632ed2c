from __future__ import annotations

import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import warm

from bodyschema.daemon.service.supervise import Child, Supervisor
from bodyschema.interfaces.errors import BodyschemaError

LIMIT_S = 500.0
# Writes its process id, then waits for SIGTERM to end it.
WAITING = "import os, signal, sys; print(os.getpid(), file=open(sys.argv[1], 'a'), flush=True); signal.pause()"
# Fails once the other has written its process id.
FAILING_AFTER = """
import os, sys, time
while not (os.path.exists(sys.argv[1]) and os.path.getsize(sys.argv[1])):
    time.sleep(0.01)
raise SystemExit(3)
"""
STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); " + WAITING


def child(code: str, *arguments: object) -> Child:
    return Child("sampler", [sys.executable, "-c", code, *map(str, arguments)])


def wait_until(true: Callable[[], bool]) -> None:
    limit = time.monotonic() + LIMIT_S
    while not true():
        assert time.monotonic() < limit
        threading.Event().wait(0.02)


def started(file: Path) -> list[int]:
    """Return the process ids written so far."""
    return [int(line) for line in file.read_text().splitlines()] if file.exists() else []


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


@pytest.fixture
def supervise():
    """Yield a function that supervises children in a thread until the test ends."""
    running: list[tuple[Supervisor, threading.Thread]] = []

    def start(*children: Child) -> Supervisor:
        supervisor = Supervisor(children)
        running.append((supervisor, threading.Thread(target=supervisor.run)))
        running[-1][1].start()
        return supervisor

    yield start
    for supervisor, thread in running:
        supervisor.stop()
        thread.join(LIMIT_S)


def test_a_killed_child_is_started_again(tmp_path, supervise) -> None:
    supervise(child(WAITING, tmp_path / "pids"))
    wait_until(lambda: len(started(tmp_path / "pids")) == 1)
    os.kill(started(tmp_path / "pids")[0], signal.SIGKILL)
    wait_until(lambda: len(started(tmp_path / "pids")) == 2)
    first, second = started(tmp_path / "pids")
    assert (first != second, gone(second)) == (True, False)


def test_stopping_ends_every_child(tmp_path) -> None:
    supervisor = Supervisor([child(WAITING, tmp_path / "a"), child(WAITING, tmp_path / "b")])
    thread = threading.Thread(target=supervisor.run)
    thread.start()
    wait_until(lambda: bool(started(tmp_path / "a") and started(tmp_path / "b")))
    supervisor.stop()
    thread.join(LIMIT_S)
    assert gone(started(tmp_path / "a")[0])
    assert gone(started(tmp_path / "b")[0])


def test_a_child_that_does_not_end_is_killed(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.daemon.service.supervise.END_LIMIT_S", 0.1)
    supervisor = Supervisor([child(STUBBORN, tmp_path / "pids")])
    thread = threading.Thread(target=supervisor.run)
    thread.start()
    wait_until(lambda: bool(started(tmp_path / "pids")))
    supervisor.stop()
    thread.join(LIMIT_S)
    assert gone(started(tmp_path / "pids")[0])


def test_child_failing_at_start_ends_the_others(tmp_path) -> None:
    supervisor = Supervisor([child(WAITING, tmp_path / "pids"), child(FAILING_AFTER, tmp_path / "pids")])
    with pytest.raises(BodyschemaError, match=r"could not start \(exit code 3\); its message is above"):
        supervisor.run()
    (other,) = started(tmp_path / "pids")
    assert gone(other)


SERVING_THEN_FAILING = (
    "from bodyschema.daemon.service.signals import tell_parent_serving; tell_parent_serving(); "
    + WAITING.replace("signal.pause()", "raise SystemExit(1)")
)


def test_child_failing_after_serving_is_restarted(tmp_path, supervise) -> None:
    supervise(child(SERVING_THEN_FAILING, tmp_path / "pids"))
    wait_until(lambda: len(started(tmp_path / "pids")) == 2)


def test_child_failing_late_without_serving_is_not_restarted(monkeypatch) -> None:
    minutes = iter(range(0, 6000, 60))
    monkeypatch.setattr("bodyschema.daemon.service.supervise.time.monotonic", lambda: float(next(minutes)))
    with pytest.raises(BodyschemaError, match=r"could not start \(exit code 1\)"):
        Supervisor([child("raise SystemExit(1)")]).run()


def test_the_command_run_ends_both_processes_on_sigterm(tmp_path, free_endpoint) -> None:
    with running(_robot(tmp_path, free_endpoint(), free_endpoint()), tmp_path / "log") as run:
        children = _children(run.pid)
        run.send_signal(signal.SIGTERM)
        assert run.wait(LIMIT_S) == 0, (tmp_path / "log").read_text()
    assert len(children) == 2
    assert all(map(gone, children))


def test_a_killed_run_takes_both_processes_with_it(tmp_path, free_endpoint) -> None:
    with running(_robot(tmp_path, free_endpoint(), free_endpoint()), tmp_path / "log") as run:
        children = [os.pidfd_open(pid) for pid in _children(run.pid)]
        run.kill()
        ended = [bool(select.select([child], [], [], LIMIT_S)[0]) for child in children]
    assert ended == [True, True]


def test_run_with_port_in_use_exits_with_message(tmp_path, free_endpoint) -> None:
    taken = free_endpoint()
    with socket.create_server(("127.0.0.1", int(taken.rpartition(":")[2]))):
        done = warm.run("-m", "bodyschema", "run", "--robot", _robot(tmp_path, taken, free_endpoint()))
    assert done.returncode == 1
    assert "is in use. Stop the other bodyschema" in done.stderr


@contextmanager
def running(robot: Path, log: Path) -> Iterator[warm.Child]:
    """Run `bodyschema run`, with both processes at work."""
    with log.open("wb") as stream:
        run = warm.Child("-m", "bodyschema", "run", "--robot", robot, stderr=stream)
    try:
        wait_until(lambda: log.read_bytes().count(b" answers on ") == 2)
        yield run
    finally:
        run.kill()
        run.wait()


def _children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _robot(folder: Path, sampler: str, learner: str) -> Path:
    from small_arm import write_small_arm

    (folder / "walk.csv").write_text("waist,shoulder,x,y,z\n0.1,0.2,0.3,0.4,0.5\n")
    return write_small_arm(
        folder,
        f'[zenoh]\nsampler = "{sampler}"\nlearner = "{learner}"\n[daemon]\nstate_dir = "state"\n'
        '[drivers]\nrecording = "walk.csv"\nspeed = 0\n',
    )
