"""A learner restored from a saved state learns and answers like the one that was saved."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from guided_arm import NOW_AND_THEN, Scene, make_pair, measured, new_learning, nominal_model, teach

from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.replay_memory import Permutations
from bodyschema.learning.snapshot import Prediction
from bodyschema.learning.solvers.solver import DirectSolver, Solved
from bodyschema.learning.state import StateError

TAUGHT, LATER, OTHER_TOOL_AT = 60, 20, 40


class OnlyUntilSaved(DirectSolver):
    """A solver that stops answering once the learner has been saved."""

    saved = False

    def poll(self) -> Solved | None:
        return None if self.saved else super().poll()


def same(a: Prediction, b: Prediction) -> None:
    np.testing.assert_array_equal(a.x, b.x)
    np.testing.assert_array_equal(a.sigma, b.sigma)
    np.testing.assert_array_equal(a.in_support, b.in_support)


class Saved:
    """A learner that was trained and saved, and one restored from it; neither receives solutions any more."""

    def __init__(self, pairs: list[Pair], *, tool_changed_at: int | None = None, unknown: bool = False) -> None:
        solver, known = OnlyUntilSaved(), not unknown
        nominal = nominal_model(pose_known=known, marker_known=known)
        self.learning = OnlineLearner(nominal, LearnerConfig(), solver)
        for number, pair in enumerate(pairs):
            if number == tool_changed_at:
                self.learning.tool_changed()
            teach(self.learning, [pair], background=number % NOW_AND_THEN == 0)
        self.learning.solve_soon()
        while self.learning.work():
            pass
        solver.saved = True
        again = OnlyUntilSaved()
        again.saved = True
        self.restored = OnlineLearner(nominal, LearnerConfig(), again)
        self.restored.restore(self.learning.state())

    def assert_same(self, q: FloatArray) -> None:
        same(self.learning.snapshot.predict(q), self.restored.snapshot.predict(q))


def scene_with(case: str) -> tuple[Saved, list[Pair], FloatArray]:
    """Return a saved learner, further pairs, and poses to compare at."""
    rng, scene = np.random.default_rng(1), Scene.draw(0, TAUGHT + LATER)
    q = np.vstack([scene.q, rng.uniform(-np.pi, np.pi, (50, scene.q.shape[1]))])
    pairs = scene.pairs
    if case == "other tool":
        moved = scene.chain.with_tool([0.0, 0.15, 0.2])
        pairs = pairs[:OTHER_TOOL_AT] + measured(moved, scene.q[OTHER_TOOL_AT:], rng, first=OTHER_TOOL_AT + 1)
    if case == "amid doubts":
        wild = pairs[TAUGHT - 1]
        pairs[TAUGHT - 1] = make_pair(wild.seq, wild.q, wild.x + 1.0)
    saved = Saved(
        pairs[:TAUGHT],
        tool_changed_at=OTHER_TOOL_AT if case == "other tool" else None,
        unknown=case == "frame to be found",
    )
    return saved, pairs[TAUGHT:], q


# The others go through all that the first does, and further.
CASES = [pytest.param("as drawn", marks=pytest.mark.soak), "frame to be found", "other tool", "amid doubts"]


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> tuple[Saved, list[Pair], FloatArray]:
    """Train once for both tests; the first compares before the second continues."""
    return scene_with(request.param)


def test_restored_learner_answers_like_saved_learner(case: tuple[Saved, list[Pair], FloatArray]) -> None:
    saved, _, q = case
    saved.assert_same(q)


def test_restored_learner_stays_identical_over_further_pairs(case: tuple[Saved, list[Pair], FloatArray]) -> None:
    saved, further, q = case
    for pair in further:
        teach(saved.learning, [pair], background=False)
        teach(saved.restored, [pair], background=False)
        saved.assert_same(q)


def test_a_restored_learner_replays_the_same_pairs() -> None:
    saved, further, _ = scene_with("as drawn")
    states = []
    for learning in (saved.learning, saved.restored):
        teach(learning, further)
        states.append(learning.state().arrays["net_nlms"])
    np.testing.assert_array_equal(*states)


@pytest.mark.parametrize("taken", [0, 3, 10, 13])
def test_a_restored_order_goes_on_where_it_was(taken: int) -> None:
    order, again = Permutations(seed=3), Permutations(seed=3)
    while taken > 0:
        taken -= len(order.take(taken, 10))
    again.restore(order.position)
    for _ in range(5):
        np.testing.assert_array_equal(order.take(4, 12), again.take(4, 12))


@pytest.mark.parametrize("tolerance", ["angle_tolerance_deg", "length_tolerance_m", "place_tolerance_m"])
def test_state_learnt_with_other_tolerances_is_refused(tolerance: str) -> None:
    learning = new_learning()
    teach(learning, Scene.draw(0, 3).pairs)
    other = new_learning(settings=msgspec.structs.replace(LearnerConfig(), **{tolerance: 0.5}))
    with pytest.raises(StateError, match="to other tolerances"):
        other.restore(learning.state())


def test_state_learnt_with_other_replay_count_is_restored() -> None:
    learning, other = new_learning(), new_learning(settings=LearnerConfig(replays_per_pair=1.0))
    teach(learning, Scene.draw(0, 3).pairs)
    other.restore(learning.state())
    assert other.counters.pairs == 3
