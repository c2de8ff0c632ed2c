"""What the learner answers: predictions, Jacobians and the model, from its present snapshot."""

from __future__ import annotations

from daemon.bus import Request
from daemon.learning import Learning
from daemon.wire import JacobianReply, JointsRequest, PredictReply, decode, encode, joint_angles
from interfaces.protocols import Clock


class Answers:
    """Handlers for the learner's queries. They take no lock, so that learning never delays them."""

    def __init__(self, learning: Learning, joints: tuple[str, ...], robot: str, clock: Clock) -> None:
        self._learning, self._joints, self._robot, self._clock = learning, joints, robot, clock

    def predict(self, request: Request) -> bytes:
        """Positions, 1-sigma and support; RequestError for a bad request, or before there is a model."""
        q = joint_angles(decode(request.payload, JointsRequest, request.encoding), self._joints)
        snapshot = self._learning.snapshot
        prediction = snapshot.predict(q)
        age = None if snapshot.learnt_at is None else self._clock.now() - snapshot.learnt_at
        reply = PredictReply(
            x=prediction.x.tolist(),
            sigma=prediction.sigma.tolist(),
            in_support=prediction.in_support.tolist(),
            model=snapshot.digest,
            pairs=snapshot.pairs,
            age_s=age,
        )
        return encode(reply, request.encoding)

    def jacobian(self, request: Request) -> bytes:
        """Jacobians dx/dq; RequestError as for `predict`."""
        q = joint_angles(decode(request.payload, JointsRequest, request.encoding), self._joints)
        snapshot = self._learning.snapshot
        jacobians = snapshot.require_map().jacobian(q)
        return encode(JacobianReply(jacobians.tolist(), snapshot.digest, snapshot.pairs), request.encoding)

    def model(self, _request: Request) -> bytes:
        """The model as one self-describing file, with the robot's name and joints in its metadata."""
        snapshot = self._learning.snapshot
        texts = {"robot": self._robot, "joints": " ".join(self._joints), "pairs": str(snapshot.pairs)}
        return snapshot.require_map().with_metadata(texts | {"model": snapshot.digest}).to_bytes()
