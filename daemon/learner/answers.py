"""Answer the learner's queries (predictions, Jacobians, inverse kinematics, the model) from its current snapshot."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.daemon.sampler.sources import MarkerTopic, StampedJoints
from bodyschema.daemon.transport.session import Request
from bodyschema.daemon.transport.wire import (
    IkReply,
    IkRequest,
    JacobianReply,
    JointsRequest,
    PredictReply,
    decode,
    encode,
    joint_angles,
    joint_vector,
    position,
)
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import JointReading
from bodyschema.interfaces.waits import Waits
from bodyschema.learning.model_bank import LearntModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.snapshot import NoFrameError, Prediction, Snapshot
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.hand_eye import MarkerPose
from kbmaps import InverseKinematics


class Answers:
    """Handlers for the learner's queries. They take no lock, so that learning never delays them."""

    def __init__(
        self, learning: OnlineLearner, robot: RobotDescription, age_s: Callable[[str | None], float | None]
    ) -> None:
        """Answer from the state of `learning`.

        Args:
            age_s: age of the model [s], given the time at which its newest pair was stored (`PairFeed.age_s`).
        """
        self._learning, self._robot, self._age_s = learning, robot, age_s
        self._joints = robot.joints
        self._inverse: tuple[LearntModel, InverseKinematics] | None = None

    def predict(self, request: Request) -> bytes:
        """Return positions, 1-sigma and support; raise RequestError for a bad request, or before there is a model."""
        q = joint_angles(decode(request.payload, JointsRequest, request.encoding), self._joints)
        snapshot = self._learning.snapshot
        prediction = snapshot.predict(q)
        reply = PredictReply(
            x=prediction.x.tolist(),
            sigma=prediction.sigma.tolist(),
            in_support=prediction.in_support.tolist(),
            model=snapshot.digest,
            pairs=snapshot.pairs,
            age_s=self._age_s(snapshot.newest_utc),
            R=None if prediction.R is None else prediction.R.tolist(),
            sigma_R=None if prediction.sigma_R is None else prediction.sigma_R.tolist(),
            poses=_poses(prediction),
        )
        return encode(reply, request.encoding)

    def jacobian(self, request: Request) -> bytes:
        """Return the Jacobians dx/dq; raise RequestError as `predict` does."""
        q = joint_angles(decode(request.payload, JointsRequest, request.encoding), self._joints)
        snapshot = self._learning.snapshot
        jacobians = snapshot.require_model().jacobian(q)
        return encode(JacobianReply(jacobians.tolist(), snapshot.digest, snapshot.pairs), request.encoding)

    def ik(self, request: Request) -> bytes:
        """Return joint angles that put the marker at the requested position.

        Raises:
            RequestError: as `predict` does.
        """
        wanted = decode(request.payload, IkRequest, request.encoding)
        x = position("x", wanted.x)
        start = None if wanted.start is None else joint_vector("start", wanted.start, self._joints)
        snapshot = self._learning.snapshot
        inverse = self._inverse_of(snapshot.require_model())
        if wanted.posture is None:
            posture = None
        elif wanted.posture == "middle":
            posture = inverse.middle
        else:
            posture = joint_vector("posture", wanted.posture, self._joints)
        found = inverse.solve(x, start=start, posture=posture)
        prediction = snapshot.predict(found.q[None])
        reply = IkReply(
            q=found.q.tolist(),
            x=found.x.tolist(),
            distance=found.distance,
            converged=found.converged,
            reason=found.reason,
            sigma=prediction.sigma[0].tolist(),
            in_support=bool(prediction.in_support[0]),
            model=snapshot.digest,
            pairs=snapshot.pairs,
            pose=_poses(prediction)[0],
        )
        return encode(reply, request.encoding)

    def _inverse_of(self, model: LearntModel) -> InverseKinematics:
        """Return the solver for this model.

        The last one is cached, since building it costs as much as several answers.
        """
        cached = self._inverse
        if cached is None or cached[0] is not model:
            cached = model, InverseKinematics(model, self._robot.lower, self._robot.upper)
            self._inverse = cached
        return cached[1]

    def model(self, _request: Request) -> bytes:
        """Return the best KB-Map as one self-describing file; its metadata name the robot and the answering model."""
        snapshot = self._learning.snapshot
        kbmap = snapshot.require_map()
        texts = {"robot": self._robot.name, "joints": " ".join(self._joints), "pairs": str(snapshot.pairs)}
        return kbmap.with_metadata(texts | {"model": kbmap.digest, "answering": snapshot.digest}).to_bytes()


def _poses(prediction: Prediction) -> list[MarkerPose]:
    return MarkerPose.rows(prediction.x, prediction.sigma, prediction.R, prediction.sigma_R)


log = logging.getLogger(__name__)


class ExpectedMarker:
    """Publisher that follows the encoders, and publishes the current model's prediction for them.

    Nothing is published before there is a model. For subscribers that receive no sigma, nothing is published outside
    the support of the data either.
    """

    def __init__(
        self, joints: StampedJoints, topic: MarkerTopic, snapshot: Callable[[], Snapshot], clock: Clock
    ) -> None:
        """Store the settings; nothing is opened yet.

        Args:
            snapshot: returns the current model.
        """
        self._joints, self._topic, self._snapshot, self._clock = joints, topic, snapshot, clock
        self._stop = threading.Event()
        self._due = clock.now()
        self.published = 0  # number of positions so far

    @contextmanager
    def publishing(self) -> Iterator[None]:
        """Publish within the with statement; wait for a robot that is not there yet."""
        thread = threading.Thread(target=self._run, name="expected_marker")
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()

    def take(self, reading: JointReading) -> None:
        """Publish the expected position at this reading, if one is due."""
        if self._clock.now() < self._due or self._joints.stamp_ns is None:
            return
        try:
            prediction = self._snapshot().predict(reading.q[None])
        except NoFrameError:
            return
        if not (self._topic.has_sigma or prediction.in_support[0]):
            return
        self._due = max(self._due + self._topic.period_s, self._clock.now())
        self._topic.publish(self._joints.stamp_ns, prediction.x[0], prediction.sigma[0])
        self.published += 1

    def _run(self) -> None:
        has_warned = False
        while not self._stop.is_set():
            try:
                with ExitStack() as stack:
                    stack.enter_context(self._topic)
                    self._follow(
                        stack.enter_context(ReconnectingSource(self._joints, "the robot's joints", self._clock))
                    )
            except SourceError as error:
                if not has_warned:
                    log.warning("the expected marker position is not published: %s; trying again", error)
                has_warned = True
                self._stop.wait(Waits.retry_s)

    def _follow(self, joints: ReconnectingSource[JointReading]) -> None:
        while not self._stop.is_set():
            reading = joints.read(Waits.read_s)
            if reading is not None:
                self.take(reading)
