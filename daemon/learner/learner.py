"""The learner process of one robot. It needs a sampler for new pairs, but keeps answering without one.

Threads: zenoh's (queries, from an immutable snapshot; published pairs, into a queue), one for each robot that learns
each pair immediately, a batch thread for replay and the requests to the solver, and the main thread for status and
checkpoints; `bodyschema.daemon.learner.host` has the last two.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.answers import Answers, ExpectedMarker
from bodyschema.daemon.learner.checkpoint import CheckpointError, resume_from_checkpoint, write_checkpoint
from bodyschema.daemon.learner.feed import FeedSettings, PairFeed
from bodyschema.daemon.learner.findings import Changes, Findings, FindingsBudget
from bodyschema.daemon.sampler.history import Page, read_page
from bodyschema.daemon.service.reload import reload
from bodyschema.daemon.service.service import Service, with_health
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import Request, ZenohSession
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import OCTETS, CommandReply, CommandRequest, decode, encode
from bodyschema.daemon.wiring.wiring import open_marker_topic
from bodyschema.interfaces.errors import BodyschemaError, RequestError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.waits import Waits
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import Solver, SolverSettings

log = logging.getLogger(__name__)


class _Settings:
    history_limit_s: float = 5.0  # how long a page of stored pairs is waited for
    # How long pairs may wait to be evaluated as one batch, per robot of a process, and at most [s].
    batch_wait_s, longest_together_s = 0.08, 1.0
    # Up to this many robots per process, states and checkpoints are as frequent as for one alone.
    as_often_as_one: int = 10


# Name of the loop that must keep running.
LISTENING = "learning"
LOOPS = (LISTENING, "background", "status")
COMMON_ERROR = ("vision.marker", "vision.tag", "vision.cameras", "vision.further_cameras", "marker_source")
TABLES = (
    *("robot", "camera", "zenoh", "daemon", "drivers", "learner", "effects", "background", "unexplained"),
    *COMMON_ERROR,
)
CHANGEABLE = {("learner", "checkpoint_every_s")}


class Learner:
    """One robot's learner with its answers, its checkpoint and its state of health."""

    def __init__(
        self,
        config: Config,
        solver: Solver,  # for this robot alone
        bus: ZenohSession,
        clock: Clock,
        service: Service | None = None,
        *,
        loop: str = LISTENING,  # name of its loop of new pairs for the watchdog
        robots: int = 1,  # number of robots in the process, including this one
        budget: FindingsBudget | None = None,  # their common time limit for calibration and outlook
    ) -> None:
        """Restore the learner from its checkpoint; nothing is declared yet."""
        self._config, self._bus, self._clock = config, bus, clock
        self._service = Service.unsupervised(clock) if service is None else service
        self._loop = loop
        self._settings, self._robot = config.tables.learner, config.robot
        self._keys = Keys(config.robot.name)
        self._version = version("bodyschema")  # reads a file: once, while descriptors are available
        self._nominal = NominalModel.extended_by(config.simulation)
        common, self._calibration_problem = _common_variance(config)
        self._learning, self._restore_problem = resume_from_checkpoint(
            lambda: OnlineLearner(
                self._nominal, self._settings, solver, batch_wait_s=batch_wait_s(robots), common=common
            ),
            config.checkpoint_file,
            config.robot.name,
        )
        self._feed = PairFeed(self._learning, self._history, clock, lambda: self._service.beat(loop))
        self._findings = Findings(self._learning, config.robot, clock, robots, budget)
        self._answers = Answers(self._learning, config.robot, self._feed.age_s)
        self._interval_factor = interval_factor(robots)
        self._sampler_alive = False
        self._started_at = clock.now()
        self._checkpointed_at: float | None = None
        self._checkpointed_pairs = self._learning.counters.pairs
        self._checkpoint_problem: str | None = None
        self._checkpoint_lock = threading.Lock()
        self._changes = Changes(self._robot.joints, self._learning.change)
        self._pairs_at_rest: int | None = None
        self._stop = threading.Event()
        self._failure: Exception | None = None

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Answer and learn until the end of the with statement; then write a last checkpoint."""
        listening = threading.Thread(target=self._learn_pairs, name="learn_pairs")
        listening.start()
        try:
            self._declare()
            found = open_marker_topic(self._config, self._clock)
            if found is None:
                yield
            else:
                with ExpectedMarker(*found, lambda: self._learning.snapshot, self._clock).publishing():
                    yield
        finally:
            self._stop.set()
            self._feed.wake()
            listening.join()
            self.checkpoint()

    def tick(self) -> None:
        """Write a checkpoint when one is due. Raise the exception that ended one of the threads."""
        if self._failure is not None:
            raise self._failure
        self._service.beat("status")
        waited_s = self._clock.now() - (self._checkpointed_at or self._started_at)
        new = self._learning.counters.pairs != self._checkpointed_pairs
        if new and waited_s >= self._settings.checkpoint_every_s * self._interval_factor:
            self.checkpoint()

    def checkpoint(self) -> None:
        """Write a checkpoint; a failure appears in the health."""
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
        """Return the learner's state."""
        counters = self._learning.counters
        at_rest = self._pairs_at_rest == counters.pairs  # before the status below: it is final then
        snapshot, recent = self._learning.snapshot, self._learning.recent()
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
            prequential_m=dict(recent.means),
            prequential_pairs=recent.pairs,
            claimed_error_m=self._learning.claimed_error_m(),
            common_error_m=self._learning.common_error_m(),
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
            behind=self._feed.behind,
            age_s=self._feed.age_s(snapshot.newest_utc),
            version=self._version,
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
                f"no sampler on {self._config.tables.zenoh.sampler}, so no new samples; start it with "
                "`bodyschema run sampler`. Predictions go on"
            )
        for problem in (self._feed.problem, self._checkpoint_problem, self._restore_problem, self._calibration_problem):
            if problem is not None:
                yield problem
        yield from self._findings.data_problems
        behind = self._feed.behind
        if behind >= FeedSettings.behind and not self._feed.paused:
            age_s = self._feed.age_s(self._learning.snapshot.newest_utc)
            newest = "" if age_s is None else f", and the newest that was learnt is {age_s:.0f} s old"
            yield (
                f"{behind} stored samples are not learnt yet{newest}: predictions are of that time. It catches up by "
                "itself while samples come more slowly than they are learnt; if the number grows, lower [learner] "
                "replays_per_pair or run the learner on a faster machine"
            )
        if self._feed.refused is not None:
            yield f"samples were refused, {self._learning.counters.refused} so far; the last: {self._feed.refused}"
        if self._nominal.size > SolverSettings.largest_net:
            yield f"{self._nominal.joints} joints are too many for the exact map; the others learn without it"

    def _declare(self) -> None:
        bus, keys, answers = self._bus, self._keys, self._answers
        bus.answer(keys.predict, answers.predict)
        bus.answer(keys.jacobian, answers.jacobian)
        bus.answer(keys.ik, answers.ik)
        bus.answer(keys.model, answers.model, encoding=OCTETS)
        bus.answer(keys.status("learner"), lambda request: encode(self.status(), request.encoding))
        bus.answer(keys.command("learner"), self._command)
        bus.subscribe(keys.pair, self._feed.offer, quick=True)
        bus.watch(keys.alive("sampler"), self._sampler_changed)
        bus.token(keys.alive("learner"))

    def _sampler_changed(self, alive: bool) -> None:
        self._sampler_alive = alive
        if alive:
            self._feed.wake()

    def _history(self, begin: int) -> Page:
        return read_page(self._bus.ask_one(f"{self._keys.pairs}?from={begin}", timeout_s=_Settings.history_limit_s))

    def _command(self, request: Request) -> bytes:
        command = decode(request.payload, CommandRequest, request.encoding).command
        handlers: dict[str, Callable[[], str]] = {
            "pause": self._pause,
            "resume": self._resume,
            "reset_to_prior": self._reset_to_prior,
            "tool_changed": self._tool_changed,
            "rollback": self._rollback,
            "checkpoint": self._checkpoint_now,
            "reload": self.reload,
        }
        if command not in handlers:
            raise RequestError(
                f"the learner has nothing to do with {command}. Send it to {self._keys.command('sampler')}"
            )
        message = handlers[command]()
        log.info("command %s: %s", command, message)
        return encode(CommandReply(command, message), request.encoding)

    def _pause(self) -> str:
        self._feed.pause()
        return "no samples are learnt until resume; predictions go on"

    def _resume(self) -> str:
        self._feed.resume()
        return "samples are learnt again, those missed first"

    def _reset_to_prior(self) -> str:
        with self._feed.lock:
            foreign = self._feed.foreign
            self._learning.reset_to_prior(forget_store=foreign is not None)
            self._changes.note(None)
            self._feed.restart()
        self._feed.wake()
        self.checkpoint()
        if foreign is not None:
            return f"the learner starts again with the samples of the store {foreign}"
        return "the learner is back at the nominal model; only samples from now on count"

    def _tool_changed(self) -> str:
        with self._feed.lock:
            self._learning.tool_changed()
            self._changes.note(self._learning.change)
        self.checkpoint()
        return (
            "samples with the old tool no longer count; what they taught is where learning starts again. "
            "`bodyschema command rollback` takes it back"
        )

    def _rollback(self) -> str:
        with self._feed.lock:
            undone = self._learning.change
            self._learning.rollback()
            self._changes.note(self._learning.change, rolled_back=True)
        self.checkpoint()
        since = "the last change" if undone is None else f"sample {undone.first_seq}"
        return f"the model before {since} answers again; samples since then do not count"

    def _checkpoint_now(self) -> str:
        self.checkpoint()
        if self._checkpoint_problem is not None:
            raise CheckpointError(self._checkpoint_problem)
        return f"written to {self._config.checkpoint_file}"

    def reload(self) -> str:
        """Read robot.toml again; return a message about the result.

        Raises:
            ConfigError: robot.toml is invalid; nothing changed.
        """
        found = reload(self._config, TABLES, CHANGEABLE)
        self._config, self._settings = found.config, found.config.tables.learner
        return found.message("learner")

    def _learn_pairs(self) -> None:
        set_os_thread_name()
        try:
            while not self._stop.is_set():
                self._service.beat(self._loop)
                self._feed.step(Waits.read_s)
                self._learning.learn_due(self._clock.now())
                with self._feed.lock:
                    self._changes.note(self._learning.change)
        except Exception as error:
            self._failure = error

    def work(self) -> bool:
        """Do a piece of background work; return False if nothing is left; SolverLostError: the solver lost pairs."""
        self._findings.renew()
        worked = self._learning.work()
        pairs = self._learning.counters.pairs
        self._pairs_at_rest = pairs if self._learning.at_rest and self._findings.at_rest else None
        return worked

    def restart_solver(self) -> None:
        """Send the pairs to a new solver."""
        self._learning.restart_solver()
        self._pairs_at_rest = None

    def solve_soon(self) -> None:
        """Start the solver on all pairs learnt so far, since there is no other work."""
        self._learning.solve_soon()


def set_os_thread_name() -> None:
    """Show the beginning of this thread's Python name in `top -H` and `ps -L`, where the system supports it."""
    with contextlib.suppress(OSError):
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(threading.current_thread().name[:15])


def interval_factor(robots: int) -> float:
    """Return the factor by which states and checkpoints are less frequent when `robots` robots share a process."""
    return max(1.0, robots / _Settings.as_often_as_one)


def _common_variance(config: Config) -> tuple[Callable[[FloatArray], FloatArray] | None, str | None]:
    """Return the variance of all positions due to the cameras' calibration, and the reason if it is unknown.

    Learning and predictions continue without it.
    """
    if config.tables.vision.cameras is None:
        return None, None
    from bodyschema.daemon.wiring.cameras import common_error

    try:
        error = common_error(config)
    except BodyschemaError as fault:
        return None, (
            f"the sigma of predictions leaves out how well the cameras are calibrated: {fault}. On another machine "
            "than theirs, copy the file there and restart the learner"
        )
    return None if error is None else error.variance, None


def batch_wait_s(robots: int) -> float:
    """Return how long pairs may wait to be evaluated together [s] when `robots` robots share a process."""
    return 0.0 if robots == 1 else min(_Settings.batch_wait_s * robots, _Settings.longest_together_s)


def status_line(status: LearnerStatus) -> str:
    """Return the learner's state as one line."""
    predicted_error = "" if status.claimed_error_m is None else f", {1e3 * status.claimed_error_m:.1f} mm claimed"
    return with_health(
        f"{status.state}, {status.pairs} samples, {status.answering} answers{predicted_error}", status.health
    )
