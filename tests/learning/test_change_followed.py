"""An unannounced change is detected, dated and followed at once, and can be rolled back."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
import pytest
from guided_arm import NOW_AND_THEN, Scene, built_chain, measured, new_learning, path, teach
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.changes.known_arm import ArmBeforeChange, KnownArm
from bodyschema.learning.changes.monitor import DetectedChange, Reference
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import chain_tolerances
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.state import LearningHeader, LearningState
from bodyschema.learning.uncertainty import PredictiveUncertainty
from kbmaps import ChainBelief, ChainParameters, RigidChain, change_kinds, learning_bases

SIGMA, TAUGHT, SINCE = 0.002, 180, 40
# The second joint's zero.
JOINT = 1


def with_camera_moved(chain: RigidChain) -> RigidChain:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.0, np.radians(2.0), 0.0]).as_matrix()
    pose[:3, 3] = 0.01, 0.0, 0.01
    return chain.transformed(pose)


def with_zero_moved(chain: RigidChain) -> RigidChain:
    fixed = chain.fixed.copy()
    fixed[JOINT + 1, :3, :3] = (
        Rotation.from_rotvec(np.radians(3.0) * chain.axes[JOINT]).as_matrix() @ fixed[JOINT + 1, :3, :3]
    )
    # The zero turns all that comes after the joint.
    fixed[JOINT + 1, :3, 3] = Rotation.from_rotvec(np.radians(3.0) * chain.axes[JOINT]).apply(fixed[JOINT + 1, :3, 3])
    return RigidChain(fixed, chain.axes, chain.prismatic)


CHANGES = {
    "tool": lambda chain: chain.with_tool([0.012, 0.009, 0.02]),
    "camera": with_camera_moved,
    "joint": with_zero_moved,
}


@dataclass(frozen=True)
class Followed:
    """A learner before and after an unannounced change."""

    kind: str
    learning: OnlineLearner
    before: RigidChain
    after: RigidChain
    q: FloatArray
    noticed_at: int

    @classmethod
    def draw(cls, kind: str) -> Followed:
        rng = np.random.default_rng(5)
        before, q = built_chain(rng), path(rng, TAUGHT + SINCE)
        after = CHANGES[kind](before)
        learning, detected = new_learning(settings=LearnerConfig(replays_per_pair=0.0)), 0
        teach(learning, measured(before, q[:TAUGHT], rng, sigma_m=SIGMA), every=NOW_AND_THEN)
        assert learning.counters.changes == 0
        for pair in measured(after, q[TAUGHT:], rng, first=TAUGHT + 1, sigma_m=SIGMA):
            teach(learning, [pair], background=pair.seq % NOW_AND_THEN == 0)
            if learning.counters.changes and not detected:
                detected = pair.seq
        while learning.work():
            pass
        return cls(kind, learning, before, after, q, detected)

    def error_m(self, chain: RigidChain) -> float:
        return Scene(chain, self.q[TAUGHT:], []).error_m(self.learning)


@pytest.fixture(
    scope="module",
    params=["joint", pytest.param("tool", marks=pytest.mark.soak), pytest.param("camera", marks=pytest.mark.soak)],
)
def followed(request: pytest.FixtureRequest) -> Followed:
    return Followed.draw(request.param)


def test_it_is_noticed_once_and_within_ten_pairs(followed: Followed) -> None:
    assert followed.learning.counters.changes == 1
    assert TAUGHT < followed.noticed_at <= TAUGHT + 10


def test_it_is_dated(followed: Followed) -> None:
    change = followed.learning.change
    assert change is not None
    assert change.earliest_seq - 2 <= TAUGHT + 1 <= change.latest_seq + 2


def test_true_kind_is_probable_and_no_other_named(followed: Followed) -> None:
    change = followed.learning.change
    assert change is not None
    named = change.named
    assert named is None or (named.name, named.joint) == (followed.kind, JOINT if followed.kind == "joint" else None)
    assert followed.kind in [kind.name for kind in change.kinds if kind.probability > 0.05]


def test_learner_predicts_the_changed_arm(followed: Followed) -> None:
    assert followed.error_m(followed.after) < 0.4 * followed.error_m(followed.before)


def test_rolled_back_restored_learner_predicts_the_earlier_arm(followed: Followed) -> None:
    restored = new_learning()
    restored.restore(followed.learning.state())
    restored.rollback()
    here = Scene(followed.before, followed.q[:TAUGHT], [])
    there = Scene(followed.after, followed.q[:TAUGHT], [])
    assert here.error_m(restored) < 0.5 * there.error_m(restored)


def test_rollback_keeps_counters_and_drops_later_pairs(followed: Followed) -> None:
    restored = new_learning()
    restored.restore(followed.learning.state())
    restored.rollback()
    counters = restored.counters
    assert (counters.pairs, counters.last_seq) == (TAUGHT + SINCE, TAUGHT + SINCE)
    assert restored.change is None
    change = followed.learning.change
    assert change is not None
    np.testing.assert_array_equal(restored.state().arrays["q"], followed.q[: change.first_seq - 1])


def test_pairs_dropped_by_rollback_are_not_learnt_again(followed: Followed) -> None:
    restored = new_learning()
    restored.restore(followed.learning.state())
    restored.rollback()
    again, fresh = measured(followed.before, followed.q[-2:], np.random.default_rng(1), first=TAUGHT + SINCE)
    with pytest.raises(RequestError, match="learnt already"):
        restored.learn(again, 0.0)
    restored.learn(fresh, 0.0)
    assert restored.counters.pairs == TAUGHT + SINCE + 1


def test_rollback_without_a_change_is_refused() -> None:
    with pytest.raises(RequestError, match="there was no change"):
        new_learning().rollback()


def test_announced_change_can_be_rolled_back() -> None:
    learning, scene = new_learning(), Scene.draw(0, 30)
    teach(learning, scene.pairs, every=NOW_AND_THEN)
    before = learning.snapshot.predict(scene.q).x
    learning.tool_changed()
    learning.rollback()
    np.testing.assert_array_equal(learning.snapshot.predict(scene.q).x, before)


def test_checkpoint_of_older_version_is_restored() -> None:
    learning, restored = new_learning(), new_learning()
    teach(learning, Scene.draw(0, 20).pairs, every=NOW_AND_THEN)
    state = learning.state()
    older = msgspec.to_builtins(state.header)
    del older["change"], older["before"]
    restored.restore(LearningState(msgspec.convert(older, LearningHeader), state.arrays))
    assert (restored.counters.pairs, restored.change) == (20, None)


@pytest.mark.parametrize("moved_m", [0.0, 0.02])
def test_old_model_is_replaced_only_by_better_one(moved_m: float) -> None:
    rng = np.random.default_rng(0)
    parameters = ChainParameters(built_chain(rng))
    tolerances = chain_tolerances(LearnerConfig())
    belief = ChainBelief(parameters, np.zeros(parameters.size), np.diag(np.full(parameters.size, 1e-5)), SIGMA)
    chain, q = belief.chain, path(rng, 20)
    x = chain.with_tool([0.0, moved_m, 0.0]).positions(q) + SIGMA * rng.normal(size=(*q.shape[:1], 3))
    kbmap = chain.to_kbmap(learning_bases(np.full(4, -np.pi), np.full(4, np.pi), [False] * 4))
    variance = np.full(3, SIGMA**2)
    reference = Reference(kbmap, kbmap, belief, belief, None, PredictiveUncertainty(np.zeros(3)), 500, q, x, variance)
    kinds, turns = change_kinds(parameters, 1.0), np.full((20, 4), np.nan)
    seqs, kept = tuple(range(1, 21)), (True,) * 20
    cov = np.full((20, 3, 3), np.nan)
    detected = DetectedChange(reference, kinds, SIGMA, 1.0, 0, 0, 0, seqs, kept, q, x, cov, turns)
    origin = ArmBeforeChange(detected, KnownArm(belief, tolerances))
    assert origin.improves_prediction(origin.explain(q, x), q, x) == (moved_m > 0.0)


def test_changed_arm_is_unknown_until_solver_has_pairs() -> None:
    rng = np.random.default_rng(7)
    chain, q = built_chain(rng), path(rng, 60 + SINCE)
    learning = new_learning()
    teach(learning, measured(chain, q[:60], rng, sigma_m=SIGMA), every=NOW_AND_THEN)
    assert learning.known() is not None
    after = measured(with_camera_moved(chain), q[60:], rng, first=60 + 1, sigma_m=SIGMA)
    while not learning.counters.changes:
        teach(learning, [after.pop(0)], background=False)
    assert learning.known() is None
