"""The process that learns and answers. It needs a sampler for new pairs, but goes on answering without one.

Threads: zenoh's (queries, from an immutable snapshot; published pairs, into a queue), one that learns each pair at
once, one at low priority for replay and the solver's orders, and the main thread for status and checkpoints.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version

from daemon.answers import Answers
from daemon.bus import Bus, Request
from daemon.changes import Changes
from daemon.checkpoint import CheckpointError, write_checkpoint
from daemon.config import Config
from daemon.expected import ExpectedMarker
from daemon.feed import PairFeed
from daemon.findings import Findings
from daemon.going_on import go_on
from daemon.history import Page, read_page
from daemon.keys import Keys
from daemon.learning import Learning, NominalModel
from daemon.learning.solver import LARGEST_NET
from daemon.notify import Notifier
from daemon.reload import reload
from daemon.service import Service, with_health
from daemon.signals import Wishes
from daemon.solver_process import SolverLostError, SolverProcess
from daemon.status import LearnerStatus
from daemon.wire import OCTETS, CommandReply, CommandRequest, decode, encode
from daemon.wiring import open_marker_topic
from interfaces.errors import BodyschemaError, RequestError
from interfaces.protocols import Clock

log = logging.getLogger(__name__)

TICK_S = 0.05
STATUS_EVERY_S = 1.0
HISTORY_LIMIT_S = 5.0
IDLE_S = 0.02
SOLVE_WHEN_IDLE_S = 0.5
BACKGROUND_NICENESS = 10
# What has to come round for the learner to be alive.
LOOPS = ("learning", "background", "status")
TABLES = ("robot", "camera", "zenoh", "daemon", "drivers", "learner", "effects", "unexplained")
CHANGEABLE = {("learner", "checkpoint_every_s")}
# Python hands the interpreter from thread to thread this often at least; its own 5 ms would be a query's delay.
SWITCH_INTERVAL_S = 2e-4


class Learner:
    """One robot's learner with its answers, its checkpoint and its state of health."""

    def __init__(
        self, config: Config, solver: SolverProcess, bus: Bus, clock: Clock, service: Service | None = None
    ) -> None:
        self._config, self._bus, self._clock = config, bus, clock
        self._service = Service.nobodys(clock) if service is None else service
        self._settings, self._robot = config.tables.learner, config.robot
        self._keys = Keys(config.robot.name)
        self._nominal = NominalModel.extended_by(config.simulation)
        self._learning, self._set_aside = go_on(
            lambda: Learning(self._nominal, self._settings, solver), config.checkpoint_file, config.robot.name
        )
        self._feed = PairFeed(self._learning, self._history, clock, lambda: self._service.beat("learning"))
        self._findings = Findings(self._learning, config.robot, clock)
        self._answers = Answers(self._learning, config.robot, clock)
        self._sampler_alive = False
        self._started_at = clock.now()
        self._checkpointed_at: float | None = None
        self._checkpointed_pairs = self._learning.counters.pairs
        self._checkpoint_problem: str | None = None
        self._checkpoint_lock = threading.Lock()
        self._changes = Changes(self._robot.joints, self._learning.change)
        self._rested_with: int | None = None
        self._stop = threading.Event()
        self._failure: Exception | None = None

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Answer, learn and replay from here to the end of the with statement; then write a last checkpoint."""
        threads = [
            threading.Thread(target=self._guarded, args=(loop,), name=loop.__name__.strip("_"))
            for loop in (self._learn_pairs, self._work_in_background)
        ]
        for thread in threads:
            thread.start()
        try:
            self._declare()
            with self._publishing():
                yield
        finally:
            self._stop.set()
            self._feed.wake()
            for thread in threads:
                thread.join()
            self.checkpoint()

    def _publishing(self) -> contextlib.AbstractContextManager[None]:
        found = open_marker_topic(self._config, self._clock)
        if found is None:
            return contextlib.nullcontext()
        return ExpectedMarker(*found, lambda: self._learning.snapshot, self._clock).publishing()

    def tick(self) -> None:
        """What the main thread does from time to time: a checkpoint when one is due.

        Raises:
            BaseException: whatever ended one of the threads.
        """
        if self._failure is not None:
            raise self._failure
        self._service.beat("status")
        waited_s = self._clock.now() - (self._checkpointed_at or self._started_at)
        new = self._learning.counters.pairs != self._checkpointed_pairs
        if new and waited_s >= self._settings.checkpoint_every_s:
            self.checkpoint()

    def checkpoint(self) -> None:
        """Write a checkpoint; when that fails, health says so."""
        with self._checkpoint_lock:
            state = self._learning.state()
            try:
                write_checkpoint(self._config.checkpoint_file, state, robot=self._robot.name, utc=self._clock.utc())
            except CheckpointError as error:
                if self._checkpoint_problem is None:
                    log.error("%s", error)
                self._checkpoint_problem = str(error)
            else:
                self._checkpoint_problem = None
                self._checkpointed_pairs = state.header.counters.pairs
            self._checkpointed_at = self._clock.now()

    def status(self) -> LearnerStatus:
        """The learner's state."""
        counters = self._learning.counters
        at_rest = self._rested_with == counters.pairs  # before what is said below: it is final then
        snapshot = self._learning.snapshot
        now = self._clock.now()
        written = self._checkpointed_at if self._checkpoint_problem is None else None
        return LearnerStatus(
            robot=self._robot.name,
            store=counters.store,
            state=self._state(counters.pairs),
            pairs=counters.pairs,
            last_seq=counters.last_seq,
            pairs_since_change=counters.since_change,
            sampler_alive=self._sampler_alive,
            replayed=counters.replayed,
            answering=snapshot.answering,
            prequential_m=self._learning.prequential_m(),
            claimed_error_m=self._learning.claimed_error_m(),
            curve=self._learning.curve,
            model=snapshot.digest,
            calibration=self._findings.calibration,
            outlook=self._findings.outlook,
            gaps_recovered=counters.gaps_recovered,
            refused=counters.refused,
            doubted=counters.doubted,
            changes=counters.changes,
            last_change=self._changes.status(self._learning.change, can_roll_back=self._learning.can_roll_back),
            at_rest=at_rest,
            checkpoint_age_s=None if written is None else now - written,
            uptime_s=now - self._started_at,
            health=list(self._health()),
            orientation=self._learning.orientation_status(),
            missed=counters.missed,
            version=version("bodyschema"),
        )

    def _state(self, pairs: int) -> str:
        if self._feed.paused:
            return "paused"
        if pairs == 0:
            return "waiting"
        return "aligning" if self._learning.aligning else "learning"

    def _health(self) -> Iterator[str]:
        if not self._sampler_alive:
            yield (
                f"no sampler on {self._config.tables.zenoh.sampler}, so no new pairs; start it with "
                "`bodyschema sampler`. Predictions go on"
            )
        for problem in (self._feed.problem, self._checkpoint_problem, self._set_aside):
            if problem is not None:
                yield problem
        if self._feed.refused is not None:
            yield f"pairs were refused, {self._learning.counters.refused} so far; the last: {self._feed.refused}"
        if self._nominal.size > LARGEST_NET:
            yield f"{self._nominal.joints} joints are too many for the exact map; the others learn without it"

    def _declare(self) -> None:
        bus, keys, answers = self._bus, self._keys, self._answers
        bus.answer(keys.predict, answers.predict)
        bus.answer(keys.jacobian, answers.jacobian)
        bus.answer(keys.ik, answers.ik)
        bus.answer(keys.model, answers.model, encoding=OCTETS)
        bus.answer(keys.status("learner"), lambda request: encode(self.status(), request.encoding))
        bus.answer(keys.command("learner"), self._command)
        bus.subscribe(keys.pair, self._feed.offer)
        bus.watch(keys.alive("sampler"), self._sampler_changed)
        bus.token(keys.alive("learner"))

    def _sampler_changed(self, alive: bool) -> None:
        self._sampler_alive = alive
        if alive:
            self._feed.wake()

    def _history(self, begin: int) -> Page:
        return read_page(self._bus.ask_one(f"{self._keys.pairs}?from={begin}", timeout_s=HISTORY_LIMIT_S))

    def _command(self, request: Request) -> bytes:
        command = decode(request.payload, CommandRequest, request.encoding).command
        carried_out: dict[str, Callable[[], str]] = {
            "pause": self._pause,
            "resume": self._resume,
            "reset_to_prior": self._reset_to_prior,
            "tool_changed": self._tool_changed,
            "rollback": self._rollback,
            "checkpoint": self._checkpoint_now,
            "reload": self.reload,
        }
        if command not in carried_out:
            raise RequestError(
                f"the learner has nothing to do with {command}. Send it to {self._keys.command('sampler')}"
            )
        message = carried_out[command]()
        log.info("command %s: %s", command, message)
        return encode(CommandReply(command, message), request.encoding)

    def _pause(self) -> str:
        self._feed.pause()
        return "no pairs are learnt until resume; predictions go on"

    def _resume(self) -> str:
        self._feed.resume()
        return "pairs are learnt again, those missed first"

    def _reset_to_prior(self) -> str:
        with self._feed.lock:
            foreign = self._feed.foreign_store
            self._learning.reset_to_prior(forget_store=foreign is not None)
            self._changes.note(None)
            self._feed.restart()
        self._feed.wake()
        self.checkpoint()
        if foreign is not None:
            return f"the learner begins anew with the pairs of the store {foreign}"
        return "the learner is back at the nominal model; only pairs from now on count"

    def _tool_changed(self) -> str:
        with self._feed.lock:
            self._learning.tool_changed()
            self._changes.note(self._learning.change)
        self.checkpoint()
        return "pairs with the old tool no longer count; what they taught is where learning starts again"

    def _rollback(self) -> str:
        with self._feed.lock:
            undone = self._learning.change
            self._learning.rollback()
            self._changes.note(self._learning.change, rolled_back=True)
        self.checkpoint()
        since = "the last change" if undone is None else f"pair {undone.first_seq}"
        return f"the model before {since} answers again; pairs since then do not count"

    def _checkpoint_now(self) -> str:
        self.checkpoint()
        if self._checkpoint_problem is not None:
            raise CheckpointError(self._checkpoint_problem)
        return f"written to {self._config.checkpoint_file}"

    def reload(self) -> str:
        """Read robot.toml again; what came of it.

        Raises:
            ConfigError: it is wrong; nothing changed.
        """
        found = reload(self._config, TABLES, CHANGEABLE)
        self._config, self._settings = found.config, found.config.tables.learner
        return found.message("learner")

    def _guarded(self, loop: Callable[[], None]) -> None:
        try:
            loop()
        except Exception as error:
            self._failure = error

    def _learn_pairs(self) -> None:
        while not self._stop.is_set():
            self._service.beat("learning")
            self._feed.step(IDLE_S)
            with self._feed.lock:
                self._changes.note(self._learning.change)

    def _work_in_background(self) -> None:
        with contextlib.suppress(OSError):  # niceness is a courtesy: without it answers are a little later
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), BACKGROUND_NICENESS)
        idle_since = self._clock.now()
        while not self._stop.is_set():
            self._service.beat("background")
            try:
                self._findings.renew()
                worked = self._learning.work()
                pairs = self._learning.counters.pairs
                self._rested_with = pairs if self._learning.at_rest and self._findings.at_rest else None
            except SolverLostError as error:
                log.warning("%s", error)
                self._learning.restart_solver()
                self._rested_with = None
                self._stop.wait(1.0)
                continue
            if worked:
                idle_since = self._clock.now()
                self._stop.wait(1e-4)  # whoever waits for the lock gets it now
            elif not self._stop.wait(IDLE_S) and self._clock.now() - idle_since > SOLVE_WHEN_IDLE_S:
                self._learning.solve_soon()


def run_learner(config: Config, clock: Clock, wishes: Wishes, notifier: Notifier) -> None:
    """Learn and answer until `wishes` has an end.

    Args:
        notifier: is told when all is up, that `LOOPS` work, and how the learner is.

    Raises:
        BusError: the learner's port is in use.
        CheckpointError: an unusable checkpoint cannot be moved aside.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    endpoints, service = config.tables.zenoh, Service(notifier, LOOPS, clock)
    with SolverProcess() as solver, Bus(listen=endpoints.learner, settings=config.zenoh_settings("learner")) as bus:
        learner = Learner(config, solver, bus, clock, service)
        publish = bus.publisher(Keys(config.robot.name).status("learner"))
        gc.collect()
        gc.freeze()  # what start-up left behind need not be looked through again
        with learner.serving():
            log.info("the learner of %s answers on %s", config.robot.name, endpoints.learner)
            service.ready()
            published_at = clock.now() - STATUS_EVERY_S
            while not wishes.ending:
                if clock.now() - published_at >= STATUS_EVERY_S:
                    published_at = clock.now()
                    status = learner.status()
                    publish(encode(status))
                    service.tell(status_line(status))
                if wishes.reloading:
                    wishes.reloading = False
                    _reload(learner, service)
                learner.tick()
                time.sleep(TICK_S)
            service.stopping()


def status_line(status: LearnerStatus) -> str:
    """How the learner is, in a line."""
    claimed = "" if status.claimed_error_m is None else f", {1e3 * status.claimed_error_m:.1f} mm claimed"
    return with_health(f"{status.state}, {status.pairs} pairs, {status.answering} answers{claimed}", status.health)


def _reload(learner: Learner, service: Service) -> None:
    """Whoever asked by a signal reads the log."""
    service.reloading()
    try:
        log.info("robot.toml was read again: %s", learner.reload())
    except BodyschemaError as error:
        log.error("robot.toml was read again and is not followed: %s", error)
    finally:
        service.reloaded()
