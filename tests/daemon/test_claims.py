from __future__ import annotations

import msgspec
import numpy as np
import pytest
from guided_arm import JOINTS, REACH, built_chain, make_pair, new_learning, nominal_model, path, teach

from daemon.learning.claims import Claims, ClaimsState
from daemon.learning.members import INSTANT, PRIOR, RESIDUAL, RIGID
from interfaces.records import FloatArray
from kbmaps import ChainBelief, ChainTolerances

NOISE = np.full(3, 1e-6)
FAR = np.full((1, JOINTS), 2.5)


def learnt(claims: Claims, q: FloatArray, prior_error_m: float, error_m: float = 0.0) -> None:
    """Pairs at q: there the prior is wrong by the first, the instant learner by the second error on each axis."""
    for row in q:
        claims.predicted(row, {PRIOR: np.full(3, prior_error_m), INSTANT: np.full(3, error_m)}, NOISE)
        claims.learnt(row)


def sigma(claims: Claims, name: str, q: FloatArray) -> float:
    return float(np.sqrt(claims.of(name).variance(q)).mean())


def sure_belief() -> ChainBelief:
    nominal = nominal_model()
    return nominal.belief(nominal.chain, ChainTolerances())


@pytest.fixture
def walk() -> FloatArray:
    return path(np.random.default_rng(0), 100)


def test_far_from_all_data_the_claim_is_of_the_size_of_the_priors_error(walk: FloatArray) -> None:
    claims = Claims(nominal_model().bases, 0.1)
    learnt(claims, walk, prior_error_m=0.04)
    assert sigma(claims, INSTANT, FAR) == pytest.approx(0.04, rel=0.5)


def test_at_the_data_the_claim_is_far_below_the_priors_error(walk: FloatArray) -> None:
    claims = Claims(nominal_model().bases, 0.1)
    learnt(claims, walk, prior_error_m=0.04)
    assert sigma(claims, INSTANT, walk) < 0.1 * 0.04


def test_the_priors_own_claim_is_its_error_everywhere(walk: FloatArray) -> None:
    claims = Claims(nominal_model().bases, 0.1)
    learnt(claims, walk, prior_error_m=0.04)
    assert sigma(claims, PRIOR, walk) == sigma(claims, PRIOR, FAR) == pytest.approx(0.04, rel=0.05)


def test_errors_larger_than_claimed_raise_the_claim(walk: FloatArray) -> None:
    quiet, surprised = Claims(nominal_model().bases, 0.1), Claims(nominal_model().bases, 0.1)
    learnt(quiet, walk, prior_error_m=0.02)
    learnt(surprised, walk, prior_error_m=0.02, error_m=0.03)
    assert sigma(surprised, INSTANT, FAR) > 1.5 * sigma(quiet, INSTANT, FAR)


def test_residuals_at_learnt_pairs_raise_the_claim_at_the_data(walk: FloatArray) -> None:
    claims = Claims(nominal_model().bases, 0.1)
    learnt(claims, walk, prior_error_m=0.02)
    claims.replayed(np.full((50, 3), 0.005))
    assert sigma(claims, INSTANT, walk) == pytest.approx(0.005, rel=0.2)


def test_a_tool_that_was_fitted_anew_does_not_hide_what_is_unknown_of_the_arm(walk: FloatArray) -> None:
    claims = Claims(nominal_model().bases, 0.1)
    learnt(claims, walk, prior_error_m=0.04)
    claims.change_tool(0.1)
    learnt(claims, walk[:20], prior_error_m=0.001)
    assert sigma(claims, INSTANT, FAR) == pytest.approx(0.04, rel=0.5)


def test_where_the_arm_was_seen_with_the_old_tool_only_the_new_tool_is_unknown(walk: FloatArray) -> None:
    claims = Claims(nominal_model().bases, 0.1)
    learnt(claims, walk, prior_error_m=0.04)
    claims.change_tool(0.1)
    learnt(claims, walk[:1].repeat(20, axis=0), prior_error_m=0.005)
    assert sigma(claims, INSTANT, walk[-1:]) < 0.008


def test_away_from_the_pairs_that_a_solution_knows_its_claim_grows_by_what_it_misses_at_them(walk: FloatArray) -> None:
    claims = Claims(nominal_model().bases, 0.1)
    learnt(claims, walk, prior_error_m=0.04)
    claims.solution_asked()
    claims.solution_taken(RIGID, np.full((50, 3), 0.005), sure_belief(), neighbours=True)
    assert sigma(claims, RIGID, walk) == pytest.approx(0.005, rel=0.1)
    assert sigma(claims, RIGID, FAR) == pytest.approx(np.sqrt(2.0) * 0.005, rel=0.2)


def test_residuals_within_the_noise_add_nothing_to_what_is_left_open_of_the_chain(walk: FloatArray) -> None:
    claims = Claims(nominal_model().bases, 0.1)
    learnt(claims, walk, prior_error_m=0.04)
    claims.solution_asked()
    noise = np.random.default_rng(0).normal(0.0, np.sqrt(NOISE[0]), (50, 3))
    claims.solution_taken(RIGID, noise, sure_belief(), neighbours=True)
    assert sigma(claims, RIGID, walk) < 1e-6


@pytest.mark.parametrize("answered", [RIGID, RESIDUAL])
def test_of_two_solutions_alike_the_one_that_answered_with_the_last_tool_answers_with_this_one(
    answered: str, walk: FloatArray
) -> None:
    claims = Claims(nominal_model().bases, 0.1)
    claims.change_tool(0.1, answered)
    far, alike = np.full(3, 0.04), np.full(3, 0.002)
    for name in (RIGID, RESIDUAL):
        claims.solution_taken(name, np.zeros((10, 3)), None, neighbours=True)
    for row in walk[:10]:
        claims.predicted(row, {PRIOR: far, INSTANT: far, RIGID: alike, RESIDUAL: alike}, NOISE)
    assert claims.best(PRIOR) == answered


def test_claims_are_the_same_after_a_restart(walk: FloatArray) -> None:
    claims, again = Claims(nominal_model().bases, 0.1), Claims(nominal_model().bases, 0.1)
    learnt(claims, walk, prior_error_m=0.04)
    claims.change_tool(0.1)
    learnt(claims, walk[:30], prior_error_m=0.01, error_m=0.02)
    state = msgspec.msgpack.decode(msgspec.msgpack.encode(claims.state()), type=ClaimsState)
    again.restore(state, claims.arrays(), walk[:30])
    anywhere = np.vstack([walk, FAR])
    for name in (PRIOR, INSTANT):
        np.testing.assert_allclose(again.of(name).variance(anywhere), claims.of(name).variance(anywhere), rtol=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_the_claim_holds_between_poses_of_a_sweep_in_large_steps(seed: int) -> None:
    # The gears ripple nine times a turn: what is missed at a pose says nothing of the next one, 25 degrees away.
    rng = np.random.default_rng(seed)
    chain, wave = built_chain(rng), rng.normal(0.0, 0.002, (2, JOINTS))

    def positions(q: FloatArray) -> FloatArray:
        return chain.positions(q + wave[0] * np.sin(9.0 * q) + wave[1] * np.cos(9.0 * q))

    q = 12.5 * path(rng, 300)
    q = np.abs((q + REACH) % (4.0 * REACH) - 2.0 * REACH) - REACH
    x = positions(q) + rng.normal(0.0, 5e-5, (len(q), 3))
    learning = new_learning()
    teach(learning, [make_pair(k + 1, q[k], x[k], 5e-5) for k in range(len(q))], background=False)
    while learning.work():
        pass
    between = rng.uniform(-REACH, REACH, (500, JOINTS))
    prediction = learning.snapshot.predict(between)
    within = np.abs(prediction.x - positions(between)) / prediction.sigma
    assert 0.6 < (within < 1.0).mean() < 0.8
    assert (within < 1.96).mean() > 0.93
