from __future__ import annotations

import itertools

import numpy as np
from guided_arm import Scene, nominal_model

from bodyschema.learning.changes.known_arm import KnownArm
from bodyschema.learning.changes.outlier_gate import OutlierGate, OutlierSettings
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.regime import Regime
from bodyschema.learning.uncertainty import UncertaintyTracker
from kbmaps import ChainTolerances

NEAR, LIMIT, FAR = 0.001, 0.01, 0.1


def meet(doubts: OutlierGate, number: int, distance_m: float) -> None:
    """Add an outlier identified by its number."""
    doubts.classify(np.full(1, float(number)), np.full(3, float(number)), distance_m, LIMIT)


def run(doubts: OutlierGate) -> list[float]:
    q, x = doubts.run()
    np.testing.assert_array_equal(x, np.repeat(q, 3, axis=1))
    return q[:, 0].tolist()


def test_run_contains_only_consecutive_outliers() -> None:
    doubts = OutlierGate(1)
    for number, distance in enumerate([FAR, FAR, NEAR, FAR, FAR, FAR]):
        meet(doubts, number, distance)
    assert (doubts.consecutive, run(doubts)) == (3, [3.0, 4.0, 5.0])


def test_a_pair_that_is_believed_ends_the_run() -> None:
    doubts = OutlierGate(1)
    for number, distance in enumerate([FAR, FAR, NEAR]):
        meet(doubts, number, distance)
    assert (doubts.consecutive, run(doubts)) == (0, [])


def test_a_restored_run_goes_on() -> None:
    doubts, again = OutlierGate(1), OutlierGate(1)
    for number in range(2):
        meet(doubts, number, FAR)
    again.restore(*doubts.run(), doubts.consecutive)
    meet(again, 2, FAR)
    assert (again.consecutive, run(again)) == (3, [0.0, 1.0, 2.0])


def test_run_is_limited_to_newest_change_pairs() -> None:
    doubts = OutlierGate(1)
    for number in range(OutlierSettings.change_pairs + 2):
        meet(doubts, number, FAR)
    assert run(doubts) == [float(number) for number in range(2, OutlierSettings.change_pairs + 2)]


def test_initial_pairs_contradicting_fitted_tool_join_no_run() -> None:
    nominal, scene = nominal_model(), Scene.draw(0, 8)
    tolerances = ChainTolerances(tool=0.03)
    arm = KnownArm(nominal.belief(nominal.chain, tolerances), tolerances)
    regime = Regime(nominal.prior, arm, UncertaintyTracker(nominal.bases, 0.1), LearnerConfig(), itertools.count())
    x = np.array([pair.x for pair in scene.pairs])
    x[0] += 0.2  # with the old tool
    regime.learn_former_outliers(scene.q[:6], x[:6])
    regime.gate.classify(scene.q[6], x[6], FAR, LIMIT)
    regime.drop_outliers(scene.chain.to_kbmap(nominal.bases))
    regime.gate.classify(scene.q[7], x[7], FAR, LIMIT)
    np.testing.assert_array_equal(regime.gate.run()[0], scene.q[6:])
    np.testing.assert_array_equal(regime.memory.all()[0], scene.q[1:6])
