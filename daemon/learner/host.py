"""Run one process that learns for one or several robots: zenoh session, solver process and background thread.

Each robot has its own thread for new pairs, so that a stuck sampler does not stop the others from learning. Less urgent
work is done for all in turns.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.findings import FindingsBudget
from bodyschema.daemon.learner.learner import (
    LISTENING,
    LOOPS,
    Learner,
    interval_factor,
    set_os_thread_name,
    status_line,
)
from bodyschema.daemon.learner.solver_pool import SolverPool
from bodyschema.daemon.learner.solver_process import SolverLostError, SolverProcess
from bodyschema.daemon.service.notify import Notifier
from bodyschema.daemon.service.service import Service
from bodyschema.daemon.service.signals import SignalFlags, tell_parent_serving
from bodyschema.daemon.transport.access import Names, access_control
from bodyschema.daemon.transport.identity import SECURE
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.wire import encode
from bodyschema.interfaces.errors import ConfigError, StoreUnwritable
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.waits import Waits
from bodyschema.recordings.store.file import lock


class _Settings:
    idle_s: float = 0.02  # how often a thread without work looks for some
    solve_when_idle_s: float = 0.5  # after so long without work the solver starts on all pairs
    breath_s: float = 1e-4  # a thread that waits for a lock gets it between two pieces of work
    tick_s: float = 0.05  # period of the main loop
    # Fraction of one processor; the rest is left to new pairs and queries, which share the interpreter.
    shared_work: float = 0.3
    switch_interval_s: float = 2e-4  # Python's thread switch interval; its default of 5 ms would delay every query


class Background:
    """Background work for all learners until `stop` is set, one piece for each in turn, so that none waits for another.

    Args:
        share: largest share of one processor's time; 1 for no limit.
    """

    def __init__(
        self, workers: Sequence[Learner], service: Service, clock: Clock, stop: threading.Event, *, share: float = 1.0
    ) -> None:
        self._workers, self._service, self._clock, self._stop = workers, service, clock, stop
        self._idle_ratio = 1.0 / share - 1.0
        self._idle_since = [clock.now()] * len(workers)

    def run(self) -> None:
        """Run the work: as a batch thread, or as a normal one limited to a share of a processor.

        A batch thread does not interrupt others when it wakes. It still gets its share of a busy machine. A thread of
        low priority would learn nothing for minutes there, and make all threads of the process wait when it is
        preempted while it holds Python's interpreter lock.
        """
        if self._idle_ratio == 0.0:
            with contextlib.suppress(OSError):  # optional: without it answers are slightly later
                os.sched_setscheduler(threading.get_native_id(), os.SCHED_BATCH, os.sched_param(0))
        while not self._stop.is_set():
            self._service.beat("background")
            begin = time.thread_time()
            try:
                worked = self._round()
            except SolverLostError as error:
                log.warning("%s", error)
                for worker in self._workers:
                    worker.restart_solver()
                self._stop.wait(Waits.retry_s)
                continue
            if worked:
                self._stop.wait(max(self._idle_ratio * (time.thread_time() - begin), _Settings.breath_s))
            elif not self._stop.wait(_Settings.idle_s):
                for worker, since in zip(self._workers, self._idle_since, strict=True):
                    if self._clock.now() - since > _Settings.solve_when_idle_s:
                        worker.solve_soon()

    def _round(self) -> bool:
        """Do one piece for each; return True if there was any."""
        worked = [worker.work() for worker in self._workers]
        for index, busy in enumerate(worked):
            if busy:
                self._idle_since[index] = self._clock.now()
        return any(worked)


log = logging.getLogger(__name__)


def run_learners(configs: Sequence[Config], clock: Clock, signals: SignalFlags, notifier: Notifier) -> None:
    """Learn and answer for all robots until `signals` requests the end.

    Args:
        notifier: is notified of the completed start, of working loops, and of the learners' states.

    Raises:
        ConfigError: the robots cannot be served by one process.
        BusError: a learner's port is in use.
        StoreError: another learner has the same state.
        CheckpointError: an unusable checkpoint cannot be moved aside.
    """
    sys.setswitchinterval(_Settings.switch_interval_s)
    loops = LOOPS if len(configs) == 1 else (*(_loop(config) for config in configs), *LOOPS[1:])
    service = Service(notifier, loops, clock)
    with ExitStack() as stack:
        process = stack.enter_context(SolverProcess())
        bus = stack.enter_context(ZenohSession(settings=session_settings(configs)))
        for config in configs:
            stack.enter_context(exclusive_state(config))
        learners = _learners(configs, process, bus, clock, service)
        gc.collect()
        gc.freeze()  # objects of the start-up need not be scanned again
        failed = stack.enter_context(_background_thread(learners, service, clock))
        for config, learner in zip(configs, learners, strict=True):
            stack.enter_context(learner.serving())
            log.info("the learner of %s answers on %s", config.robot.name, config.tables.zenoh.learner)
        service.ready()
        tell_parent_serving()
        serve_until_stopped(
            learners, [bus.publisher(Keys(c.robot.name).status("learner")) for c in configs], signals, service, failed
        )
        service.stopping()


@contextmanager
def exclusive_state(config: Config) -> Iterator[None]:
    """Keep other learners from the state of this one; raise StoreError if another learner has it."""
    try:
        config.state_dir.mkdir(parents=True, exist_ok=True)
        descriptor = lock(config.checkpoint_file, "learner")
    except (OSError, StoreUnwritable):  # no learner can write there, and the health says so
        yield
        return
    try:
        yield
    finally:
        os.close(descriptor)


def session_settings(configs: Sequence[Config]) -> dict[str, Any]:
    """Return zenoh's configuration of the one session of all robots.

    Raises:
        ConfigError: two have the same name, or their tables [zenoh] name different routers or certificates.
    """
    settings = configs[0].zenoh_settings("learner")
    if len(configs) == 1:
        return settings
    first, names = configs[0], set[str]()
    for config in configs:
        if config.robot.name in names:
            raise ConfigError(f"two robots are called {config.robot.name}", file=config.file, remedy="Rename one")
        names.add(config.robot.name)
        if _router_and_identity(config) != _router_and_identity(first):
            raise ConfigError(
                f"[zenoh] has another router, or other certificates, than {first.file}",
                file=config.file,
                remedy="Robots of one learner share them; else give this one a learner of its own",
            )
    for key in ("listen/endpoints", "connect/endpoints"):
        settings[key] = list(dict.fromkeys(end for c in configs for end in c.zenoh_settings("learner")[key]))
    identity = _router_and_identity(first)[1]
    if identity is not None and any(end.startswith(SECURE) for end in settings["listen/endpoints"]):
        names_by_robot = {config.robot.name: config.tables.zenoh.access or Names() for config in configs}
        settings["access_control"] = access_control(names_by_robot, by_user=identity.by_user)
    return settings


def _router_and_identity(config: Config) -> tuple[str, Any]:
    return config.tables.zenoh.router, config.tables.zenoh.identity(config.file.parent)


def _loop(config: Config) -> str:
    return f"{LISTENING} {config.robot.name}"


def _learners(
    configs: Sequence[Config], process: SolverProcess, bus: ZenohSession, clock: Clock, service: Service
) -> list[Learner]:
    if len(configs) == 1:
        return [Learner(configs[0], process, bus, clock, service)]
    shared, budget = SolverPool(process), FindingsBudget()
    return [
        Learner(
            config, shared.new_solver(), bus, clock, service, loop=_loop(config), robots=len(configs), budget=budget
        )
        for config in configs
    ]


@contextmanager
def _background_thread(learners: Sequence[Learner], service: Service, clock: Clock) -> Iterator[list[Exception]]:
    """Run the background thread; an exception that ended it early is in the list."""
    stop, failed = threading.Event(), list[Exception]()
    share = 1.0 if len(learners) == 1 else _Settings.shared_work
    background = Background(learners, service, clock, stop, share=share)

    def run_guarded() -> None:
        set_os_thread_name()
        try:
            background.run()
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=run_guarded, name="background")
    thread.start()
    try:
        yield failed
    finally:
        stop.set()
        thread.join()


def serve_until_stopped(
    learners: Sequence[Learner],
    publishers: Sequence[Any],
    signals: SignalFlags,
    service: Service,
    failed: Sequence[Exception],
) -> None:
    """Publish states, write checkpoints and serve requests until the end is requested."""
    every_s = Waits.status_every_s * interval_factor(len(learners))  # a status takes milliseconds
    begin = time.monotonic()
    due = [begin + every_s * k / len(learners) for k in range(len(learners))]
    while not signals.ending:
        # Taken before the round: a request during it is for every learner, in the next round.
        reloading, signals.reloading = signals.reloading, False
        for k, (learner, publish) in enumerate(zip(learners, publishers, strict=True)):
            if time.monotonic() >= due[k]:
                due[k] = time.monotonic() + every_s
                status = learner.status()
                publish(encode(status))
                line = status_line(status)
                service.report_status(line if len(learners) == 1 else f"{len(learners)} robots; {status.robot}: {line}")
            if reloading:
                service.reload_and_report(learner.reload)
            learner.tick()
        if failed:
            raise failed[0]
        time.sleep(_Settings.tick_s)
