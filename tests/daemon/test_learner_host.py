"""Several robots on one learner host: one session, one solver, work in turns."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from guided_arm import JOINTS, nominal_model
from small_arm import write_small_arm
from told_statuses import LEARNER

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.host import (
    Background,
    exclusive_state,
    run_learners,
    serve_until_stopped,
    session_settings,
)
from bodyschema.daemon.learner.learner import Learner
from bodyschema.daemon.learner.solver_pool import SolverPool
from bodyschema.daemon.learner.solver_process import SolverLostError
from bodyschema.daemon.service.notify import Notifier
from bodyschema.daemon.service.service import Service
from bodyschema.daemon.service.signals import SignalFlags
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import client
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import decode
from bodyschema.fleet.hosting import configs_of, descriptions, shares
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import BusError, ConfigError, StoreError
from bodyschema.learning.solvers.solver import Solved, Task
from kbmaps import ChainTolerances

NOMINAL = nominal_model()
LIMIT_S = 500.0
TASK = Task(1, NOMINAL.prior, NOMINAL.belief(NOMINAL.chain, ChainTolerances()))


def described(folder: Path, name: str, learner: str, more: str = "") -> Path:
    (folder / name).mkdir()
    file = write_small_arm(folder / name, f'[zenoh]\nlearner = "{learner}"\n{more}[daemon]\nstate_dir = "state"\n')
    file.write_text(file.read_text().replace('name = "arm"', f'name = "{name}"'))
    return file


@pytest.fixture
def robots(tmp_path: Path, free_endpoint: Callable[[], str]) -> list[Config]:
    endpoint = free_endpoint()
    return [Config.load(described(tmp_path, name, endpoint)) for name in ("left", "right")]


def asked(endpoint: str, robot: str) -> LearnerStatus:
    """Return the state of a robot's learner as soon as it answers."""
    deadline = time.monotonic() + LIMIT_S
    while True:
        try:
            with client(endpoint) as bus:
                return decode(bus.ask_one(Keys(robot).status("learner")), LearnerStatus)
        except BusError:
            if time.monotonic() > deadline:
                raise


def test_one_process_answers_for_every_robot(robots: list[Config]) -> None:
    signals = SignalFlags()
    host = threading.Thread(target=run_learners, args=(robots, SystemClock(), signals, Notifier()))
    host.start()
    try:
        said = [asked(robots[0].tables.zenoh.learner, name) for name in ("left", "right")]
    finally:
        signals.end()
        host.join()
    assert [status.robot for status in said] == ["left", "right"]
    assert all(config.checkpoint_file.exists() for config in robots)


@pytest.mark.parametrize("killed", [False, True])
def test_a_second_learner_on_the_state_is_refused(robots: list[Config], killed: bool) -> None:
    """Another process has the lock, since locks belong to processes; its end releases it however it ends."""
    file = robots[0].checkpoint_file
    file.parent.mkdir(parents=True, exist_ok=True)
    code = (
        "import sys; from pathlib import Path; from bodyschema.recordings.store.file import lock\n"
        "lock(Path(sys.argv[1]), 'learner'); print('locked', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, file], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        if killed:
            other.kill()
            other.wait()
            with exclusive_state(robots[0]):
                pass
        else:
            with pytest.raises(StoreError, match=f"another learner is writing {file}"), exclusive_state(robots[0]):
                pass
            other.terminate()


class Attended:
    """A learner that receives a request while it is served, and whose process ends two rounds later."""

    def __init__(self, signals: SignalFlags, wishing: bool) -> None:
        self.signals, self.wishing, self.rounds, self.reloads = signals, wishing, 0, 0

    def status(self) -> LearnerStatus:
        return LEARNER

    def reload(self) -> str:
        self.reloads += 1
        return "in force"

    def tick(self) -> None:
        self.rounds += 1
        if self.wishing and self.rounds == 1:
            self.signals.reloading = True
        if self.rounds == 3:
            self.signals.end()


def test_mid_round_reload_reaches_every_robot_once() -> None:
    signals, clock = SignalFlags(), SystemClock()
    learners = [Attended(signals, wishing) for wishing in (False, True, False)]
    service = Service(Notifier(), (), clock)
    serve_until_stopped(cast("list[Learner]", learners), [lambda _: None] * 3, signals, service, [])
    assert [learner.reloads for learner in learners] == [1, 1, 1]


def test_two_robots_of_one_name_are_refused(robots: list[Config]) -> None:
    with pytest.raises(ConfigError, match="two robots are called left"):
        session_settings([robots[0], robots[0]])


def test_robots_of_different_routers_are_refused(tmp_path: Path, robots: list[Config]) -> None:
    other = described(tmp_path, "spare", "tcp/127.0.0.1:7999", 'router = "tcp/127.0.0.1:7450"\n')
    with pytest.raises(ConfigError, match="another router"):
        session_settings([*robots, Config.load(other)])


def test_a_folder_stands_for_the_robots_in_it(tmp_path: Path, robots: list[Config]) -> None:
    assert descriptions([tmp_path]) == [config.file for config in robots]


def test_other_toml_in_folder_is_not_a_robot(tmp_path: Path, robots: list[Config]) -> None:
    (tmp_path / "cameras.toml").write_text('format = "bodyschema stereo rig 1"\n')
    assert descriptions([tmp_path]) == [config.file for config in robots]


def test_a_folder_without_robots_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no robot\.toml is in this folder"):
        descriptions([tmp_path])


def test_a_description_out_of_reach_is_named(tmp_path: Path) -> None:
    beyond = tmp_path / ("too long " * 40)
    assert descriptions([beyond]) == [beyond]
    with pytest.raises(ConfigError, match="cannot be read"):
        configs_of([beyond], None)


def test_each_robot_has_its_own_state_folder(tmp_path: Path, robots: list[Config]) -> None:
    configs = configs_of([config.file for config in robots], tmp_path / "states")
    assert [config.state_dir for config in configs] == [tmp_path / "states" / name for name in ("left", "right")]


def test_robots_of_one_endpoint_are_not_parted(robots: list[Config]) -> None:
    with pytest.raises(ConfigError, match="cannot share the 1 endpoints"):
        shares(robots, 2)


# --- one solver for several


class ScriptedProcess:
    """A process that answers at the test's command and may be lost."""

    def __init__(self) -> None:
        self.told: list[tuple[str, int]] = []
        self.answer: Solved | None = None
        self.lost = False

    def start(self, task: Task, robot: int) -> None:
        self.told.append(("start", robot))

    def learn(self, q: object, x: object, cov: object, turns: object, robot: int) -> None:
        self.told.append(("learn", robot))

    def solve(self, robot: int) -> None:
        self.told.append(("solve", robot))

    def poll(self) -> Solved | None:
        if self.lost:
            raise SolverLostError("lost")
        answer, self.answer = self.answer, None
        return answer


@pytest.fixture
def process() -> ScriptedProcess:
    return ScriptedProcess()


@pytest.fixture
def shared(process: ScriptedProcess) -> SolverPool:
    return SolverPool(process)  # type: ignore[arg-type]


def pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((count, JOINTS)), np.zeros((count, 3))


def test_solver_orders_wait_while_another_robot_is_solved(shared: SolverPool, process: ScriptedProcess) -> None:
    first, second = shared.new_solver(), shared.new_solver()
    for new_solver in (first, second):
        new_solver.start(TASK)
        new_solver.learn(*pairs(10))
        new_solver.solve()
    first.poll()
    assert process.told == [("start", 0), ("learn", 0), ("solve", 0)]
    process.answer = Solved(1, 10, "", None, None, last=True)
    assert second.poll() is None
    assert process.told[3:] == [("start", 1), ("learn", 1), ("solve", 1)]
    assert first.poll() is not None


def test_robot_with_most_new_pairs_is_solved_next(shared: SolverPool, process: ScriptedProcess) -> None:
    busy, old, new = (shared.new_solver() for _ in range(3))
    for new_solver, count in ((busy, 10), (old, 10), (new, 10)):
        new_solver.learn(*pairs(count))
        new_solver.solve()
        new_solver.poll()
        process.answer = Solved(1, count, "", None, None, last=True)
        new_solver.poll()
    busy.solve()
    busy.poll()
    old.learn(*pairs(1))
    new.learn(*pairs(9))
    old.solve()
    new.solve()
    process.answer = Solved(1, 10, "", None, None, last=True)
    busy.poll()
    assert process.told[-1] == ("solve", 2)


def test_a_lost_process_leaves_no_order_behind(shared: SolverPool, process: ScriptedProcess) -> None:
    first, second = shared.new_solver(), shared.new_solver()
    second.learn(*pairs(5))
    first.learn(*pairs(5))
    first.solve()
    first.poll()
    process.lost = True
    second.solve()
    with pytest.raises(SolverLostError):
        first.poll()
    process.lost = False
    assert (second.is_requested, second.poll()) == (False, None)


# --- work in turns


class Scripted:
    """A learner with a given number of work items, which stops the host after the last."""

    def __init__(self, name: str, pieces: int, done: list[str], end: Callable[[], None]) -> None:
        self._name, self._left, self._done, self._end = name, pieces, done, end

    def work(self) -> bool:
        if self._left == 0:
            return False
        self._left -= 1
        self._done.append(self._name)
        if len(self._done) == 6:
            self._end()
        return True

    def restart_solver(self) -> None: ...

    def solve_soon(self) -> None: ...


def test_no_robot_waits_for_another_s_backlog() -> None:
    stop, done = threading.Event(), list[str]()
    workers = [Scripted("busy", 4, done, stop.set), Scripted("quiet", 2, done, stop.set)]
    background = Background(workers, Service.unsupervised(SystemClock()), SystemClock(), stop)
    thread = threading.Thread(target=background.run)  # its thread becomes a batch thread, for good
    thread.start()
    thread.join()
    assert done == ["busy", "quiet", "busy", "quiet", "busy", "busy"]


def test_background_work_neither_interrupts_others_nor_starves() -> None:
    stop, seen = threading.Event(), list[tuple[int, int]]()

    def end() -> None:
        seen.append((os.sched_getscheduler(threading.get_native_id()), os.getpriority(os.PRIO_PROCESS, 0)))
        stop.set()

    background = Background([Scripted("one", 6, [], end)], Service.unsupervised(SystemClock()), SystemClock(), stop)
    thread = threading.Thread(target=background.run)
    thread.start()
    thread.join()
    assert seen == [(os.SCHED_BATCH, os.getpriority(os.PRIO_PROCESS, 0))]
