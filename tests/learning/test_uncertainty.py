from __future__ import annotations

import msgspec
import numpy as np
import pytest
from guided_arm import JOINTS, REACH, built_chain, make_pair, measured, new_learning, nominal_model, path, teach

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.model_bank import INSTANT, PRIOR, RESIDUAL, RIGID
from bodyschema.learning.nominal import chain_tolerances
from bodyschema.learning.uncertainty import UncertaintyState, UncertaintyTracker
from bodyschema.learning.variance_terms import QueryPoints
from kbmaps import ChainBelief, ChainParameters, ChainTolerances

NOISE = np.full(3, 1e-6)
FAR = np.full((1, JOINTS), 2.5)
NOMINAL = nominal_model()
MODEL = NOMINAL.prior
TOLERANCES = chain_tolerances(LearnerConfig())
DRAWN = NOMINAL.belief(NOMINAL.chain, TOLERANCES)


def new_claims(belief: ChainBelief = DRAWN) -> UncertaintyTracker:
    uncertainty = UncertaintyTracker(NOMINAL.bases, 0.1)
    uncertainty.set_prior(belief)
    return uncertainty


def learnt(uncertainty: UncertaintyTracker, q: FloatArray, prior_error_m: float, error_m: float = 0.0) -> None:
    """Learn pairs at q, where the prior errs by the first, the instant learner by the second error on each axis."""
    for row in q:
        x = MODEL.predict(row[None]) + prior_error_m
        uncertainty.predicted(QueryPoints(row[None]), x, {PRIOR: x - prior_error_m, INSTANT: x - error_m}, NOISE[None])
        uncertainty.learnt(row[None])


def sigma(uncertainty: UncertaintyTracker, name: str, q: FloatArray) -> float:
    return float(np.sqrt(uncertainty.of(name, MODEL.predict).variance(q)).mean())


def sure_belief(shift_m: float = 0.0) -> ChainBelief:
    """Return a belief without uncertainty in the nominal chain, shifted on each axis."""
    shift = np.eye(4)
    shift[:3, 3] = shift_m
    return NOMINAL.belief(NOMINAL.chain.transformed(shift), ChainTolerances())


@pytest.fixture
def walk() -> FloatArray:
    return path(np.random.default_rng(0), 100)


@pytest.mark.parametrize("name", [PRIOR, INSTANT])
def test_sigma_far_from_data_is_the_tolerance_spread(name: str, walk: FloatArray) -> None:
    uncertainty = new_claims()
    learnt(uncertainty, walk, prior_error_m=0.001)
    claimed = uncertainty.of(name, MODEL.predict).variance(FAR)
    np.testing.assert_allclose(claimed, DRAWN.predict_with_variance(FAR)[1], rtol=0.05)


def test_untrained_learner_claims_the_tolerance_spread() -> None:
    q = np.random.default_rng(0).uniform(-REACH, REACH, (50, JOINTS))
    variance = DRAWN.predict_with_variance(q)[1]
    np.testing.assert_allclose(new_learning().snapshot.predict(q).sigma, np.sqrt(variance), rtol=1e-6)


def test_instant_learner_sigma_is_small_near_data_only(walk: FloatArray) -> None:
    uncertainty = new_claims(sure_belief(0.04))
    learnt(uncertainty, walk, prior_error_m=0.04)
    assert sigma(uncertainty, INSTANT, walk) < 0.25 * 0.04
    assert sigma(uncertainty, INSTANT, FAR) == pytest.approx(0.04, rel=0.1)


def test_prior_sigma_equals_distance_to_the_fitted_chain(walk: FloatArray) -> None:
    uncertainty = new_claims()
    uncertainty.fitted(sure_belief(0.04))
    learnt(uncertainty, walk, prior_error_m=0.04)
    assert sigma(uncertainty, PRIOR, walk) == pytest.approx(0.04, rel=0.05)
    assert sigma(uncertainty, PRIOR, FAR) == pytest.approx(0.04, rel=0.05)


def test_errors_larger_than_claimed_raise_the_claim(walk: FloatArray) -> None:
    quiet, surprised = new_claims(), new_claims()
    learnt(quiet, walk, prior_error_m=0.02)
    learnt(surprised, walk, prior_error_m=0.02, error_m=0.3)
    assert sigma(surprised, INSTANT, FAR) > 1.5 * sigma(quiet, INSTANT, FAR)


def test_residuals_at_learnt_pairs_raise_sigma_there(walk: FloatArray) -> None:
    uncertainty = new_claims(sure_belief())
    learnt(uncertainty, walk, prior_error_m=0.02)
    uncertainty.replayed(np.full((50, 3), 0.005))
    assert sigma(uncertainty, INSTANT, walk) == pytest.approx(0.005, rel=0.2)


@pytest.mark.parametrize(
    "known",
    [(True, False), *(pytest.param(known, marks=pytest.mark.soak) for known in ((False, True), (False, False)))],
)
def test_sigma_outside_first_pairs_covers_nominal_model_error(known: tuple[bool, bool]) -> None:
    parameters, within, beyond = ChainParameters(NOMINAL.chain), [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        drawn = parameters.standard_deviations(TOLERANCES) * rng.normal(size=parameters.size)
        chain = parameters.chain(drawn).with_tool(0.1 * rng.normal(size=3) * (not known[1]))
        learning = new_learning(nominal_model(pose_known=known[0], marker_known=known[1]))
        teach(learning, measured(chain, path(rng, 15), rng))
        q = rng.uniform(-REACH, REACH, (100, JOINTS))
        told = learning.snapshot.predict(q)
        off = np.abs(told.x - chain.positions(q)) / told.sigma
        within.append((off < 1.0).mean())
        beyond.append((off > 3.0).mean())
    # Two thirds would be right. Over many arms it is about half, which differs by 0.15 from arm to arm; 0.7 where
    # neither camera nor marker is known.
    assert np.mean(within) > 0.4
    assert np.mean(beyond) < 0.1


def test_solution_sigma_grows_by_its_misfit_outside_data(walk: FloatArray) -> None:
    uncertainty = new_claims()
    learnt(uncertainty, walk, prior_error_m=0.04)
    uncertainty.record_request()
    uncertainty.record_solution(RIGID, np.full((50, 3), 0.005), sure_belief(), neighbours=True)
    assert sigma(uncertainty, RIGID, walk) == pytest.approx(0.005, rel=0.1)
    assert sigma(uncertainty, RIGID, FAR) == pytest.approx(np.sqrt(2.0) * 0.005, rel=0.2)


def test_residuals_within_noise_do_not_raise_sigma(walk: FloatArray) -> None:
    uncertainty = new_claims()
    learnt(uncertainty, walk, prior_error_m=0.04)
    uncertainty.record_request()
    noise = np.random.default_rng(0).normal(0.0, np.sqrt(NOISE[0]), (50, 3))
    uncertainty.record_solution(RIGID, noise, sure_belief(), neighbours=True)
    assert sigma(uncertainty, RIGID, walk) < 1e-6


@pytest.mark.parametrize("answered", [RIGID, RESIDUAL])
def test_previously_answering_model_wins_tie_after_tool_change(answered: str, walk: FloatArray) -> None:
    uncertainty = new_claims()
    uncertainty.change_tool(0.1, answered)
    uncertainty.set_prior(DRAWN)
    far, alike = 0.04, 0.002
    for name in (RIGID, RESIDUAL):
        uncertainty.record_solution(name, np.zeros((10, 3)), None, neighbours=True)
    for row in walk[:10]:
        x = MODEL.predict(row[None]) + alike
        missed = {PRIOR: far, INSTANT: far, RIGID: alike, RESIDUAL: alike}
        uncertainty.predicted(QueryPoints(row[None]), x, {name: x - miss for name, miss in missed.items()}, NOISE[None])
    assert uncertainty.best(PRIOR) == answered


def test_claims_are_the_same_after_a_restart(walk: FloatArray) -> None:
    uncertainty, again = new_claims(), new_claims()
    learnt(uncertainty, walk, prior_error_m=0.04)
    uncertainty.change_tool(0.1)
    uncertainty.set_prior(DRAWN)
    learnt(uncertainty, walk[:30], prior_error_m=0.01, error_m=0.02)
    state = msgspec.msgpack.decode(msgspec.msgpack.encode(uncertainty.state()), type=UncertaintyState)
    again.restore(state, uncertainty.arrays())
    anywhere = np.vstack([walk, FAR])
    for name in (PRIOR, INSTANT):
        np.testing.assert_allclose(
            again.of(name, MODEL.predict).variance(anywhere),
            uncertainty.of(name, MODEL.predict).variance(anywhere),
            rtol=1e-9,
        )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.soak
def test_sigma_covers_errors_between_poses_of_coarse_sweep(seed: int) -> None:
    # The gears ripple nine times per turn: the error at a pose is unrelated to the next one, 25 degrees away.
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
