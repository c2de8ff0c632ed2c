"""Evaluate the learner's answers against the simulator's ground truth on held-out poses.

The held-out poses are near those that the arm has been guided through, with each joint moved by a few degrees: within
the support of the data, but not part of it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from bodyschema.daemon.transport.bus import ZenohSession
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.wire import JointsRequest, PairsReply, PredictReply, decode, encode
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from kbmaps import RigidChain, nearest_rotation, rotation_matrices, rotation_vectors

POSES = 300
JITTER_DEG = 3.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of the evaluation.

    Attributes:
        pairs: number of pairs that the answering model had learnt.
        error_m: mean distance between prediction and ground truth on held-out poses [m].
        nominal_m: the same for the nominal model [m].
        within_sigma: share of coordinates within the predicted 1-sigma.
        angle_rad: mean angle between predicted and true orientation there [rad]; None if none is learnt.
        angles_within_sigma: share of the angles' components within the predicted 1-sigma.
    """

    pairs: int
    error_m: float
    nominal_m: float
    within_sigma: float
    angle_rad: float | None = None
    angles_within_sigma: float | None = None


class Judge:
    """Compares the learner's answers with the simulated ground truth."""

    def __init__(self, robot: RobotDescription, sampler: ZenohSession, learner: ZenohSession, seed: int) -> None:
        self._robot, self._sampler, self._learner = robot, sampler, learner
        self._keys = Keys(robot.name)
        self._rng = np.random.default_rng(seed)
        self._seen = np.empty((0, len(robot.joints)))
        self._region_start = 0

    @property
    def seen(self) -> int:
        """Number of accepted pairs fetched so far."""
        return len(self._seen)

    def follow(self) -> None:
        """Fetch the joint angles of the pairs accepted since the last call."""
        while True:
            request = f"{self._keys.pairs}?from={len(self._seen) + 1}"
            reply = decode(self._sampler.ask_one(request), PairsReply)
            if reply.pairs:
                self._seen = np.vstack([self._seen, [pair.q for pair in reply.pairs]])
            if len(self._seen) >= reply.last_seq or not reply.pairs:
                return

    def new_region(self) -> None:
        """Restart the region of the data: from now on only new pairs define it."""
        self._region_start = len(self._seen)

    def change_tool(self, marker_xyz: FloatArray) -> None:
        """Change the tool in the robot's hand."""
        self._sampler.ask_one(self._keys.simulation, json.dumps({"tool": marker_xyz.tolist()}).encode())

    def truth(self) -> RigidChain:
        """Return the true kinematics of the simulated robot, with the marker's rotation in its last frame."""
        raw = json.loads(self._sampler.ask_one(self._keys.simulation))
        fixed = np.array(raw["fixed"])
        fixed[-1, :3, :3] = nearest_rotation(fixed[-1, :3, :3] @ np.array(raw["turn"]))
        return RigidChain(fixed, axes=np.array(raw["axes"]), prismatic=np.array(raw["prismatic"], dtype=bool))

    def verdict(self) -> Verdict | None:
        """Evaluate the learner's current answers; return None before any pair."""
        self.follow()
        region = self._seen[self._region_start :]
        if not len(region):
            return None
        poses = region[self._rng.integers(len(region), size=POSES)]
        poses = poses + self._rng.normal(0.0, np.radians(JITTER_DEG), poses.shape)
        poses = np.clip(poses, self._robot.lower, self._robot.upper)
        truth = self.truth()
        x_true = truth.positions(poses)
        request = encode(JointsRequest(poses.tolist()))
        answer = decode(self._learner.ask_one(self._keys.predict, request), PredictReply)
        miss = np.array(answer.x) - x_true
        return Verdict(
            pairs=answer.pairs,
            error_m=float(np.linalg.norm(miss, axis=1).mean()),
            nominal_m=float(np.linalg.norm(self._robot.chain.positions(poses) - x_true, axis=1).mean()),
            within_sigma=float((np.abs(miss) <= np.array(answer.sigma)).mean()),
            **_turned(answer, truth.orientation(poses)),
        )


def _turned(answer: PredictReply, truth: FloatArray) -> dict[str, float]:
    """Return the errors of predicted orientations against the true ones (n, 3, 3); empty if none are learnt."""
    if answer.R is None or answer.sigma_R is None:
        return {}
    turns = rotation_vectors(rotation_matrices("R", answer.R) @ truth.swapaxes(1, 2))
    return {
        "angle_rad": float(np.linalg.norm(turns, axis=1).mean()),
        "angles_within_sigma": float((np.abs(turns) <= np.array(answer.sigma_R)).mean()),
    }
