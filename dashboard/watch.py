"""Follow both processes over zenoh, and keep the hub's documents up to date."""

from __future__ import annotations

import logging
import threading
import time
from contextlib import ExitStack
from importlib.metadata import version
from typing import Any, Generic, Self, TypeVar

from bodyschema.cli.recordings.recorder import History
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.identity import Route
from bodyschema.daemon.transport.keys import CommandName, Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import CommandReply, CommandRequest, JointsRequest, PredictReply, decode, encode
from bodyschema.dashboard.course import ChangeHistory, Series, expected_outlook
from bodyschema.dashboard.documents import Process, ProcessDocument, RobotDocument
from bodyschema.dashboard.hub import Hub
from bodyschema.dashboard.recent import RecentPairs, RecentSettings, cloud
from bodyschema.dashboard.scene import arm
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import BusError, RecordingError, RequestError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.waits import Waits


class _Settings:
    silent_after_s: float = 5.0  # a process publishes its status every second; less often on a busy machine
    cloud_every_s: float = 2.0  # interval between two sets of pairs
    picture_every_s: float = 0.5  # interval between two pictures of a camera
    trail: int = 80  # pairs before the newest whose measured positions are shown
    command_limit_s: float = 10.0  # longer than a tool change or switching torque on takes


S = TypeVar("S", SamplerStatus, LearnerStatus)


class LatestStatus(Generic[S]):
    """Newest status of one process; any thread may use it."""

    def __init__(self, kind: type[S], endpoint: str, clock: Clock) -> None:
        self._kind, self._endpoint, self._clock = kind, endpoint, clock
        self._lock = threading.Lock()
        self._alive = False
        self._heard_at: float | None = None
        self._heard_utc: float | None = None
        self._status: S | None = None
        self._fields: dict[str, Any] | None = None
        self._problem: str | None = None

    @property
    def status(self) -> S | None:
        """Last status, even if the process has gone."""
        with self._lock:
            return self._status

    @property
    def answers(self) -> bool:
        """True if the process is alive now."""
        with self._lock:
            return self._is_alive()

    def take(self, payload: bytes, utc: float) -> None:
        """Store a published status, received at this time [s since 1970]."""
        try:
            status, fields, problem = decode(payload, self._kind), decode(payload, dict[str, Any]), None
        except RequestError as error:
            status, fields, problem = None, None, f"{error}. Is it of another version?"
        with self._lock:
            self._heard_at, self._heard_utc, self._problem = self._clock.now(), utc, problem
            if status is not None:
                self._status, self._fields = status, fields

    def note_alive(self, alive: bool) -> None:
        """Record that its liveliness token appeared or disappeared."""
        with self._lock:
            self._alive = alive

    @property
    def document(self) -> ProcessDocument:
        """State for the page."""
        with self._lock:
            return ProcessDocument(self._is_alive(), self._endpoint, self._heard_utc, self._problem, self._fields)

    def _is_alive(self) -> bool:
        recent = self._heard_at is not None and self._clock.now() - self._heard_at < _Settings.silent_after_s
        return self._alive and recent


log = logging.getLogger(__name__)


class ProcessFollower:
    """Follower of both processes within a with statement; they may come and go."""

    def __init__(self, config: Config, hub: Hub) -> None:
        """Initialise without opening anything; documents go to `hub`."""
        self._config, self._hub = config, hub
        self._clock = SystemClock()
        self._keys = Keys(config.robot.name)
        routes: dict[Process, Route] = {"sampler": config.route("sampler"), "learner": config.route("learner")}
        self._sampler = LatestStatus(SamplerStatus, str(routes["sampler"]), self._clock)
        self._learner = LatestStatus(LearnerStatus, str(routes["learner"]), self._clock)
        self._sessions = {process: ZenohSession(connect=route) for process, route in routes.items()}
        self._series, self._course = Series(), ChangeHistory()
        self._recent = RecentPairs()
        self._history: History | None = None
        self._store: str | None = None
        self._predicted: tuple[int, PredictReply] | None = None
        self._picture: tuple[float, bytes] | None = None
        self._picturing = threading.Lock()
        self._cloud_version: tuple[str, int] | None = None
        self._cloud_at = -_Settings.cloud_every_s
        self._stopping = threading.Event()
        self._open: ExitStack | None = None

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for session in self._sessions.values():
                stack.enter_context(session)
            self._listen()
            worker = threading.Thread(target=self._work, name="view")
            worker.start()
            stack.callback(worker.join)
            stack.callback(self._stopping.set)
            self._open = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        if self._open is not None:
            self._open.close()

    def command(self, process: Process, name: CommandName) -> str:
        """Send a command to a process and return its reply.

        Raises:
            BusError: it does not answer.
            RequestError: it refused.
        """
        payload = encode(CommandRequest(name))
        reply = self._sessions[process].ask_one(
            self._keys.command(process), payload, timeout_s=_Settings.command_limit_s
        )
        return decode(reply, CommandReply).message

    def picture(self) -> bytes:
        """Return the sampler's newest camera picture with detections, as JPEG; at most one request each half second.

        Raises:
            BusError: the sampler does not answer, or has no cameras.
            RequestError: no frame has come yet.
        """
        with self._picturing:
            now = self._clock.now()
            if self._picture is None or now - self._picture[0] > _Settings.picture_every_s:
                jpeg = self._sessions["sampler"].ask_one(self._keys.picture, timeout_s=Waits.answer_limit_s)
                self._picture = now, jpeg
            return self._picture[1]

    def history(self, newest: int) -> History:
        """Return the sampler's newest pairs, `newest` of them, to be read page by page.

        Raises:
            BusError: the sampler does not answer.
        """
        status = self._sampler.status
        if status is None or not self._sampler.answers:
            raise BusError(
                "the sampler does not answer, and it has the samples. Start it with `bodyschema run sampler`"
            )
        return History(self._sessions["sampler"], self._config.robot, max(1, status.pairs - newest + 1))

    def _listen(self) -> None:
        robot, joints = self._config.robot, self._config.robot.joints
        slides = tuple(name for name, slides in zip(joints, robot.chain.prismatic, strict=True) if slides)
        self._hub.put("robot", RobotDocument(robot.name, joints, slides, version("bodyschema")))
        heard_of: dict[Process, LatestStatus[SamplerStatus] | LatestStatus[LearnerStatus]]
        heard_of = {"sampler": self._sampler, "learner": self._learner}
        for process, heard in heard_of.items():
            session = self._sessions[process]
            session.subscribe(self._keys.status(process), lambda payload, heard=heard: heard.take(payload, time.time()))
            session.watch(self._keys.alive(process), heard.note_alive)

    def _work(self) -> None:
        while True:
            try:
                self._look()
            except (BusError, RequestError, RecordingError) as error:
                log.debug("%s", error)  # the page shows which process does not answer
            except Exception:
                log.exception("the page is not up to date")
            if self._stopping.wait(Waits.status_every_s):
                return

    def _look(self) -> None:
        self._hub.put("sampler", self._sampler.document)
        self._hub.put("learner", self._learner.document)
        status = self._learner.status if self._learner.answers else None
        if status is not None:
            self._course.note(status, time.time())
            self._hub.put("outlook", expected_outlook(status))
        self._hub.put("course", self._course.document)
        self._note_figures(status)
        if self._sampler.answers:
            self._catch_up()
        if status is not None:
            self._renew_cloud(status)
        self._show_arm(status)

    def _show_arm(self, learner: LearnerStatus | None) -> None:
        newest = self._recent.newest
        if newest is None:
            return
        # The prediction was requested before newer pairs arrived.
        seq, reply = self._predicted or (newest.seq, None)
        pairs = self._recent.upto(seq, _Settings.trail) or self._recent.upto(newest.seq, _Settings.trail)
        reply = reply if pairs[-1].seq == seq and learner is not None else None
        self._hub.put("arm", arm(self._config.robot, pairs, learner, reply))

    def _note_figures(self, learner: LearnerStatus | None) -> None:
        sampler = self._sampler.status if self._sampler.answers else None
        self._series.add(
            time.time(),
            error_m=None if learner is None else learner.prequential_m.get(learner.answering),
            expected_m=None if learner is None else learner.expected_error_m(learner.claimed_error_m),
            pairs_per_s=None if sampler is None else sampler.pairs_per_s,
            predict_s=None if learner is None else self._predict_time(),
        )
        self._hub.put("series", self._series.document)

    def _predict_time(self) -> float | None:
        """Return the round-trip time of one prediction [s], as for any program."""
        newest, robot = self._recent.newest, self._config.robot
        q = (0.5 * (robot.lower + robot.upper) if newest is None else newest.q).tolist()
        begin = time.perf_counter()
        try:
            reply = self._predict([q])
        except (BusError, RequestError):
            return None
        took_s = time.perf_counter() - begin
        self._predicted = None if newest is None else (newest.seq, reply)
        return took_s

    def _predict(self, q: list[list[float]]) -> PredictReply:
        payload = encode(JointsRequest([*q]))
        reply = self._sessions["learner"].ask_one(self._keys.predict, payload, timeout_s=Waits.answer_limit_s)
        return decode(reply, PredictReply)

    def _catch_up(self) -> None:
        status = self._sampler.status
        if status is None:
            return
        restarted = self._history is not None and status.pairs < self._history.next_seq - 1
        if self._history is None or status.store != self._store or restarted:
            self._history, self._store, self._recent = self.history(RecentSettings.kept), status.store, RecentPairs()
            self._predicted = None
        had = len(self._recent), self._recent.newest
        while page := self._history.page():
            self._recent.add(page)
        if had != (len(self._recent), self._recent.newest):
            self._hub.put("segments", self._recent.segments())

    def _renew_cloud(self, status: LearnerStatus) -> None:
        now = self._clock.now()
        of = (status.model, status.last_seq)
        if of == self._cloud_version or now - self._cloud_at < _Settings.cloud_every_s or status.store != self._store:
            return
        pairs = self._recent.chosen(status.last_seq - status.pairs_since_change, status.last_seq)
        self._hub.put("cloud", cloud(pairs, self._predict))
        self._cloud_version, self._cloud_at = of, now
