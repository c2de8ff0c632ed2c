from __future__ import annotations

import numpy as np
import pytest
from planted_chains import bases_for, random_chain, random_map, random_q

from kbmaps import (
    DegenerateDataError,
    ExactLearner,
    NonFiniteError,
    SettingError,
    ShapeError,
    prediction_errors,
    with_refitted_tool,
)


@pytest.mark.parametrize("kinds", ["RRRR", "RPRR"])
def test_one_pair_refits_tool_of_exact_arm(kinds):
    rng = np.random.default_rng(1)
    chain = random_chain(rng, kinds)
    changed = chain.with_tool([0.1, -0.2, 0.05])
    q, test = random_q(rng, kinds, 1, 80), random_q(rng, kinds, 100, 80)
    refitted = with_refitted_tool(chain.to_kbmap(bases_for(kinds)), chain, q, changed.positions(q))
    assert prediction_errors(refitted, test, changed.positions(test)).max() < 1e-10


def test_tool_refit_keeps_learnt_geometry():
    rng = np.random.default_rng(2)
    true = random_chain(rng, "RRRR")
    fixed = true.fixed.copy()
    fixed[:, :3, 3] += 0.02 * rng.normal(size=(5, 3))
    nominal = type(true)(fixed, true.axes, true.prismatic)
    q = random_q(rng, "RRRR", 200, 80)
    learner = ExactLearner(nominal.to_kbmap(bases_for("RRRR")))
    learner.learn(q, true.positions(q))
    changed = true.with_tool([0.25, 0.0, 0.0])
    refitted = with_refitted_tool(learner.solve().map, nominal, q[:20], changed.positions(q[:20]))
    # Links were moved but not turned, so the nominal orientations are right and the refit is exact.
    assert prediction_errors(refitted, q, changed.positions(q)).max() < 1e-8


def test_without_pairs_nothing_can_be_refitted():
    chain = random_chain(np.random.default_rng(3), "RR")
    with pytest.raises(DegenerateDataError):
        with_refitted_tool(
            random_map(np.random.default_rng(1), bases_for("RR")), chain, np.empty((0, 2)), np.empty((0, 3))
        )


@pytest.mark.parametrize(
    ("pairs", "sigma", "error"), [(1, None, ShapeError), (3, -0.01, SettingError), (3, float("nan"), NonFiniteError)]
)
def test_pairs_that_do_not_fit_together_are_refused(pairs, sigma, error):
    rng = np.random.default_rng(4)
    chain = random_chain(rng, "RR")
    with pytest.raises(error):
        with_refitted_tool(
            chain.to_kbmap(bases_for("RR")), chain, random_q(rng, "RR", 3, 80), np.zeros((pairs, 3)), sigma
        )
