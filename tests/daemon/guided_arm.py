"""A small arm as described and as built, guided along a path: pairs with a ground truth hidden from the learner."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.records import FloatArray, Pair, frozen_array
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from kbmaps import RigidChain

JOINTS = 4
REACH = np.radians(60.0)
STEP = np.radians(2.0)
STORE = "one"
# A solver that is asked so rarely is as good after a hundred pairs, and much cheaper.
NOW_AND_THEN = 60


def nominal_chain() -> RigidChain:
    x, y, z = np.eye(3)
    fixed = np.tile(np.eye(4), (JOINTS + 1, 1, 1))
    fixed[:, :3, 3] = [(0.9, 0.1, 0.4), (0.0, 0.0, 0.15), (0.3, 0.0, 0.0), (0.02, 0.24, 0.0), (0.05, 0.02, 0.16)]
    return RigidChain(fixed, np.array([z, y, z, x]), np.zeros(JOINTS, dtype=bool))


def built_chain(rng: np.random.Generator, axis_deg: float = 2.0, shift_m: float = 0.01) -> RigidChain:
    nominal = nominal_chain()
    fixed = nominal.fixed.copy()
    for transform in fixed:
        transform[:3, :3] = Rotation.from_rotvec(np.radians(axis_deg) * rng.normal(size=3)).as_matrix()
        transform[:3, 3] += shift_m * rng.normal(size=3)
    return RigidChain(fixed, nominal.axes, nominal.prismatic)


def path(rng: np.random.Generator, count: int) -> FloatArray:
    """Return straight paths between random waypoints in steps of 2 degrees, shape (count, JOINTS)."""
    q, goal = [np.zeros(JOINTS)], rng.uniform(-REACH, REACH, JOINTS)
    while len(q) < count:
        if np.linalg.norm(goal - q[-1]) < STEP:
            goal = rng.uniform(-REACH, REACH, JOINTS)
        way = goal - q[-1]
        q.append(q[-1] + STEP * way / np.linalg.norm(way))
    return np.array(q)


def near(rng: np.random.Generator, q: FloatArray, count: int = 400) -> FloatArray:
    """Return poses within a few degrees of those in q, none of them in it."""
    chosen = q[rng.integers(len(q), size=count)]
    return chosen + rng.normal(0.0, np.radians(3.0), chosen.shape)


def make_pair(seq: int, q: FloatArray, x: FloatArray, sigma_m: float = 0.002, store: str = STORE) -> Pair:
    return Pair(
        store=store,
        seq=seq,
        segment=1,
        t=seq / 30.0,
        utc="2026-11-21T12:00:00.000+00:00",
        q=frozen_array(q),
        x=frozen_array(x),
        cov=frozen_array(sigma_m**2 * np.eye(3)),
    )


def measured(
    chain: RigidChain, q: FloatArray, rng: np.random.Generator, *, first: int = 1, sigma_m: float = 0.002
) -> list[Pair]:
    x = chain.positions(q) + sigma_m * rng.normal(size=(len(q), 3))
    return [make_pair(first + k, q[k], x[k], sigma_m) for k in range(len(q))]


def nominal_model(*, pose_known: bool = True, marker_known: bool = True) -> NominalModel:
    limit = np.full(JOINTS, np.radians(90.0))
    return NominalModel(nominal_chain(), -limit, limit, pose_known, marker_known)


def new_learning(nominal: NominalModel | None = None, settings: LearnerConfig | None = None) -> OnlineLearner:
    return OnlineLearner(nominal or nominal_model(), settings or LearnerConfig(), DirectSolver())


def teach(learning: OnlineLearner, pairs: Iterable[Pair], *, background: bool = True, every: int = 10) -> None:
    """Learn pairs, with all background work done after each `every` pairs and at the end."""
    for number, pair in enumerate(pairs, 1):
        learning.learn(pair, pair.t)
        while background and number % every == 0 and learning.work():
            pass
    while background and learning.work():
        pass


@dataclass(frozen=True)
class Scene:
    """An arm as built, a path of it, and the pairs measured there."""

    chain: RigidChain
    q: FloatArray
    pairs: list[Pair]

    @classmethod
    def draw(cls, seed: int, count: int, sigma_m: float = 0.002) -> Scene:
        rng = np.random.default_rng(seed)
        chain, q = built_chain(rng), path(rng, count)
        return cls(chain, q, measured(chain, q, rng, sigma_m=sigma_m))

    def error_m(self, learning: OnlineLearner, seed: int = 0) -> float:
        """Return the mean distance between the learner's answers and the truth, near the path."""
        q = near(np.random.default_rng(seed), self.q)
        miss = learning.snapshot.predict(q).x - self.chain.positions(q)
        return float(np.linalg.norm(miss, axis=1).mean())
