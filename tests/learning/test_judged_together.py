"""Pairs judged in batches, as by a host of many robots: the instant learner does not wait."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from guided_arm import JOINTS, NOW_AND_THEN, Scene, built_chain, make_pair, measured, nominal_model, path, teach

from bodyschema.interfaces.records import Pair
from bodyschema.learning.changes.known_arm import KnownArm
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.model_bank import INSTANT
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner, OnlineSettings
from bodyschema.learning.regime import Regime
from bodyschema.learning.solvers.solver import DirectSolver
from bodyschema.learning.uncertainty import ErrorMemory, UncertaintyTracker
from kbmaps import NLMS, ChainTolerances

BATCH_WAIT_PER_ROBOT_S = 1.0
SETTINGS = LearnerConfig(replays_per_pair=0.0)
NOMINAL = nominal_model()
TOLERANCES = ChainTolerances(axes=0.05, points=0.015, zeros=0.05, tool=0.03)


def new_learning(batch_wait_s: float = BATCH_WAIT_PER_ROBOT_S, nominal: NominalModel = NOMINAL) -> OnlineLearner:
    return OnlineLearner(nominal, SETTINGS, DirectSolver(), batch_wait_s=batch_wait_s)


def taught(pairs: list[Pair], batch_wait_s: float) -> OnlineLearner:
    learning = new_learning(batch_wait_s)
    teach(learning, pairs, every=NOW_AND_THEN)
    return learning


def with_outliers(pairs: list[Pair], places: list[int]) -> list[Pair]:
    wild = {place: make_pair(pairs[place].seq, pairs[place].q, pairs[place].x + 0.8) for place in places}
    return [wild.get(place, pair) for place, pair in enumerate(pairs)]


def test_instant_learner_learns_pairs_before_outlier_test() -> None:
    scene = Scene.draw(0, 20)
    regime = Regime(
        NOMINAL.prior,
        KnownArm(NOMINAL.belief(NOMINAL.chain, TOLERANCES), TOLERANCES),
        UncertaintyTracker(NOMINAL.bases, 0.1),
        SETTINGS,
        itertools.count(),
    )
    reference = NLMS(NOMINAL.prior)
    for pair in scene.pairs:
        regime.learn_instantly(pair)
        reference.learn(pair.q, pair.x)
    assert regime.memory.count == 0
    np.testing.assert_allclose(regime.models.map(INSTANT).net, reference.map.net, atol=1e-10)


def test_batches_find_the_same_outliers_as_single_pairs() -> None:
    wild = [60, 70, 81, 95]
    pairs = with_outliers(Scene.draw(1, 100).pairs, wild)
    good = np.delete([pair.x for pair in pairs], wild, axis=0)
    for seconds in (BATCH_WAIT_PER_ROBOT_S, 0.0):
        state = taught(pairs, seconds).state()
        assert state.header.counters.doubted == 4
        np.testing.assert_array_equal(state.arrays["x"], good)


@pytest.mark.soak
def test_batched_pairs_teach_as_well_as_single_pairs() -> None:
    scene = Scene.draw(2, 60)
    together, each = (scene.error_m(taught(scene.pairs, seconds)) for seconds in (BATCH_WAIT_PER_ROBOT_S, 0.0))
    assert together < 1.1 * each


def test_waiting_pairs_are_part_of_the_state() -> None:
    learning = new_learning()
    teach(learning, Scene.draw(3, 57).pairs, background=False)
    assert len(learning.state().arrays["q"]) == 57


def test_waiting_pairs_are_judged_without_further_pairs() -> None:
    learning, pairs = new_learning(), Scene.draw(3, 43).pairs
    teach(learning, pairs, background=False)
    waiting = learning.curve[-1].pairs
    learning.learn_due(pairs[-1].t + BATCH_WAIT_PER_ROBOT_S)
    assert (waiting < 43, learning.curve[-1].pairs) == (True, 43)


def test_the_solver_is_given_the_pairs_that_waited() -> None:
    learning = new_learning()
    teach(learning, Scene.draw(3, 57).pairs, background=False)
    learning.solve_soon()
    while learning.work():
        pass
    assert learning.at_rest


@pytest.mark.soak
@pytest.mark.parametrize("moved_m", [0.025, 0.3])
def test_change_is_detected_within_one_batch(moved_m: float) -> None:
    rng, before = np.random.default_rng(5), 150
    chain, q = built_chain(rng), path(rng, 200)
    pairs = measured(chain, q[:before], rng)
    pairs += measured(chain.with_tool([moved_m, 0.0, 0.0]), q[before:], rng, first=before + 1)
    noticed = [taught(pairs, seconds).change for seconds in (0.0, BATCH_WAIT_PER_ROBOT_S)]
    at_once, together = (0 if change is None else change.noticed_seq for change in noticed)
    assert before < at_once
    assert before < together <= at_once + OnlineSettings.max_together


def test_pairs_after_a_change_join_the_new_regime() -> None:
    rng, before = np.random.default_rng(6), 95  # pairs of the batch are left when the change is noticed
    chain, q = built_chain(rng), path(rng, before + 50)
    moved = chain.with_tool([0.3, 0.0, 0.0])
    pairs = measured(chain, q[:before], rng) + measured(moved, q[before:], rng, first=before + 1)
    learning = taught(pairs, BATCH_WAIT_PER_ROBOT_S)
    assert learning.counters.changes == 1
    np.testing.assert_array_equal(learning.state().arrays["x"], [pair.x for pair in pairs[before:]])


def test_batched_errors_weigh_like_single_errors() -> None:
    rng = np.random.default_rng(7)
    errors, variances, ratios = rng.normal(size=(9, 3)), rng.random((9, 3)), rng.random(9)
    together, each = ErrorMemory(0.1), ErrorMemory(0.1)
    together.add(errors, variances, ratios)
    for row in range(9):
        each.add(errors[row : row + 1], variances[row : row + 1], ratios[row : row + 1])
    found = [[m.weight, *m.square, *m.noise, m.ratio] for m in (together, each)]
    np.testing.assert_allclose(*found, rtol=1e-12)


def test_support_set_is_the_same_for_batched_pairs() -> None:
    q = path(np.random.default_rng(8), 120)
    together, each = UncertaintyTracker(NOMINAL.bases, 0.1), UncertaintyTracker(NOMINAL.bases, 0.1)
    together.learnt(q)
    for row in q:
        each.learnt(row[None])
    np.testing.assert_array_equal(together.arrays()["support_q"], each.arrays()["support_q"])
    assert together.arrays()["support_q"].shape[1] == JOINTS
