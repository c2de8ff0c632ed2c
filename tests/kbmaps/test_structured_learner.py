from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, half_ranges, random_chain, random_q
from rough_arms import ROUGH, rough_arm

from kbmaps import (
    BasisError,
    ChainParameters,
    ChainTolerances,
    DegenerateDataError,
    InverseKinematics,
    KernelLearner,
    Model,
    ModelFormatError,
    NonFiniteError,
    RigidChain,
    StructuredLearner,
)

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=2, max_size=4)


@given(seed=seeds, joint_kinds=kinds, pairs=st.integers(1, 40))
def test_it_is_the_gaussian_posterior_with_the_covariance_of_its_definition(seed, joint_kinds, pairs):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, joint_kinds)
    q, x = arm.pairs(rng, pairs, 0.01)
    learner = StructuredLearner(arm.nominal, ROUGH, bases_for(joint_kinds))
    learner.learn(q, x, 0.01)
    test = random_q(rng, joint_kinds, 5, 80)
    estimate = learner.estimate(test)
    # J S Jᵀ + τ² k ⊗ 1 + σ² 1, all of it written out.
    parameters = ChainParameters(arm.nominal)
    all_q = np.concatenate([q, test])
    nominal, jacobian = parameters.linearised(np.zeros(parameters.size), all_q)
    scaled = (jacobian * parameters.standard_deviations(ROUGH)).reshape(3 * len(all_q), -1)
    weights = arm.nominal.to_kbmap(bases_for(joint_kinds)).weights(all_q)
    covariance = scaled @ scaled.T + learner.residual_std**2 * np.kron(weights @ weights.T, np.eye(3))
    seen = 3 * pairs
    noisy = covariance[:seen, :seen] + 1e-4 * np.eye(seen)
    gain = np.linalg.solve(noisy, covariance[:seen, seen:]).T
    expected = nominal[pairs:].ravel() + gain @ (x - nominal[:pairs]).ravel()
    left = np.diag(covariance[seen:, seen:] - gain @ covariance[:seen, seen:])
    np.testing.assert_allclose(estimate.x.ravel(), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.square(estimate.sigma.ravel()), left, rtol=1e-6, atol=1e-12)


@given(seed=seeds, joint_kinds=kinds)
def test_without_tolerances_it_is_the_kernel_learner(seed, joint_kinds):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, joint_kinds)
    q, x = arm.pairs(rng, 30, 0.01)
    structured = StructuredLearner(arm.nominal, ChainTolerances(), bases_for(joint_kinds))
    kernel = KernelLearner(bases_for(joint_kinds), arm.nominal)
    structured.learn(q, x)
    kernel.learn(q, x)
    np.testing.assert_allclose(structured.predict(q), kernel.predict(q), rtol=0, atol=1e-9)


@given(seed=seeds, joint_kinds=kinds)
def test_the_order_of_the_pairs_does_not_matter(seed, joint_kinds):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, joint_kinds)
    q, x = arm.pairs(rng, 40, 0.01)
    straight, shuffled = (StructuredLearner(arm.nominal, ROUGH, bases_for(joint_kinds)) for _ in range(2))
    order = rng.permutation(40)
    straight.learn(q, x)
    for part in np.array_split(order, 5):
        shuffled.learn(q[part], x[part])
    np.testing.assert_allclose(straight.predict(q), shuffled.predict(q), rtol=0, atol=1e-5)


def test_thirty_noisy_pairs_are_enough_where_a_plain_net_needs_hundreds():
    structured, isotropic, drawing = [], [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng, "RRRRRR")
        q, x = arm.pairs(rng, 30, 0.01)
        learners = (
            StructuredLearner(arm.nominal, ROUGH, bases_for("RRRRRR")),
            KernelLearner(bases_for("RRRRRR"), arm.nominal),
        )
        drawing.append(arm.error(learners[0], rng))
        for learner, errors in zip(learners, (structured, isotropic), strict=True):
            learner.learn(q, x)
            errors.append(arm.error(learner, rng))
    assert np.mean(structured) < 0.3 * np.mean(isotropic)
    assert np.mean(isotropic) < np.mean(drawing)


@given(seed=seeds, joint_kinds=st.text("RP", min_size=4, max_size=6), pairs=st.integers(20, 60))
def test_tolerances_without_bounds_beside_narrow_ones_leave_the_noise_as_it_is(seed, joint_kinds, pairs):
    rng = np.random.default_rng(seed)
    narrow = ChainTolerances(axes=math.radians(1.0), points=0.005, zeros=math.radians(1.0))
    arm = rough_arm(rng, joint_kinds, narrow)
    q, x = arm.pairs(rng, pairs, 0.0005)
    unbounded = replace(narrow, tool=math.inf, base_rotation=math.inf, base_translation=math.inf)
    learner = StructuredLearner(arm.nominal, unbounded, bases_for(joint_kinds))
    learner.learn(q, x)
    assert 0.0001 < learner.noise < 0.005
    assert arm.error(learner, rng) < 0.03


def test_what_is_not_rigid_goes_to_the_map():
    rng = np.random.default_rng(1)
    arm = rough_arm(rng, "RRRR")
    bases = bases_for("RRRR")
    q = random_q(rng, "RRRR", 400, 80)
    bent = arm.real.positions(q)
    bent[:, 2] += 0.03 * np.cos(q[:, 1]) * np.cos(q[:, 2]) * np.sin(q[:, 3])
    learner = StructuredLearner(arm.nominal, ROUGH, bases)
    learner.learn(q[:300], bent[:300] + 0.001 * rng.normal(size=(300, 3)))
    errors = np.linalg.norm(learner.predict(q[300:]) - bent[300:], axis=1)
    assert errors.mean() < 0.002
    assert learner.residual_std > 1e-4


def test_its_control_points_are_those_of_its_predictions():
    rng = np.random.default_rng(2)
    arm = rough_arm(rng, "RPRR")
    learner = StructuredLearner(arm.nominal, ROUGH, bases_for("RPRR"))
    learner.learn(*arm.pairs(rng, 40, 0.01))
    q = random_q(rng, "RPRR", 200, 80)
    np.testing.assert_allclose(learner.to_kbmap().predict(q), learner.predict(q), rtol=0, atol=1e-12)


def test_it_can_be_told_where_to_reach():
    rng = np.random.default_rng(9)
    arm = rough_arm(rng, "RRPR")
    learner = StructuredLearner(arm.nominal, ROUGH, bases_for("RRPR"))
    learner.learn(*arm.pairs(rng, 60, 0.005))
    np.testing.assert_allclose(
        learner.jacobian(q := random_q(rng, "RRPR", 30, 80)), learner.to_kbmap().jacobian(q), rtol=0, atol=1e-10
    )
    reach = half_ranges("RRPR", 80)
    solver = InverseKinematics(learner, -reach, reach)
    target = learner.predict(random_q(rng, "RRPR", 1, 60)[0])
    np.testing.assert_allclose(learner.predict(solver.solve(target).q), target, rtol=0, atol=1e-6)


def test_a_small_change_of_the_chain_is_found():
    rng = np.random.default_rng(3)
    arm = rough_arm(rng, "RRRRR", ChainTolerances(axes=1e-4, points=1e-4, tool=1e-3))
    learner = StructuredLearner(arm.nominal, ChainTolerances(axes=1e-4, points=1e-4, tool=1e-3), bases_for("RRRRR"))
    q, x = arm.pairs(rng, 200)
    learner.learn(q, x, 1e-6)
    fitted = ChainParameters(arm.nominal).chain(learner.change)
    test = random_q(rng, "RRRRR", 100, 80)
    np.testing.assert_allclose(fitted.positions(test), arm.real.positions(test), rtol=0, atol=2e-6)


def test_before_the_first_pair_the_tolerances_are_the_claim():
    rng = np.random.default_rng(4)
    errors, claims = [], []
    for _ in range(40):
        arm = rough_arm(rng, "RRRR")
        estimate = StructuredLearner(arm.nominal, ROUGH, bases_for("RRRR")).estimate(q := random_q(rng, "RRRR", 50, 80))
        errors.append(np.square(estimate.x - arm.real.positions(q)).mean())
        claims.append(np.square(estimate.sigma).mean())
        assert not estimate.in_support.any()
    assert math.sqrt(np.mean(errors) / np.mean(claims)) == pytest.approx(1.0, abs=0.25)


def test_support_is_where_pairs_were():
    rng = np.random.default_rng(5)
    arm = rough_arm(rng, "RRRRRR")
    learner = StructuredLearner(arm.nominal, ROUGH, bases_for("RRRRRR"))
    learner.learn(*arm.pairs(rng, 200, 0.005, reach_deg=15.0))
    near, far = random_q(rng, "RRRRRR", 100, 12), random_q(rng, "RRRRRR", 100, 150)
    assert learner.estimate(near).in_support.all()
    assert learner.estimate(far).in_support.mean() < 0.2


@given(seed=seeds, told=st.booleans())
def test_its_bytes_predict_the_same_to_the_last_bit(seed, told):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, "RPR")
    learner: Model = StructuredLearner(arm.nominal, ROUGH, bases_for("RPR"))
    learner.learn(*arm.pairs(rng, 20, 0.01), 0.01 if told else None)
    again = StructuredLearner.from_bytes(learner.to_bytes())
    q = random_q(rng, "RPR", 20, 80)
    before, after = learner.estimate(q), again.estimate(q)
    np.testing.assert_array_equal(before.x, after.x)
    np.testing.assert_array_equal(before.sigma, after.sigma)
    assert again.to_bytes() == learner.to_bytes()


def test_infinite_tolerances_survive_in_bytes():
    chain = random_chain(np.random.default_rng(6), "RR")
    learner = StructuredLearner(chain, ChainTolerances(tool=math.inf), bases_for("RR"))
    again = StructuredLearner.from_bytes(learner.to_bytes())
    assert again.to_bytes() == learner.to_bytes()


def test_bytes_of_something_else_are_refused():
    chain = random_chain(np.random.default_rng(7), "RR")
    with pytest.raises(ModelFormatError):
        StructuredLearner.from_bytes(KernelLearner(bases_for("RR"), chain).to_bytes())
    with pytest.raises(ModelFormatError):
        StructuredLearner.from_bytes(b"nothing")


def test_misuse_is_refused_and_changes_nothing():
    chain: RigidChain = random_chain(np.random.default_rng(8), "RR")
    with pytest.raises(BasisError, match="2 bases"):
        StructuredLearner(chain, ROUGH, bases_for("R"))
    learner = StructuredLearner(chain, ROUGH, bases_for("RR"))
    with pytest.raises(DegenerateDataError):
        _ = learner.noise
    with pytest.raises(NonFiniteError):
        learner.learn([0.0, math.nan], np.zeros(3))
    assert learner.pairs == 0


@pytest.mark.soak
def test_its_claims_hold_on_average_over_arms():
    inside: list[np.ndarray] = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng, "RRRRRR")
        learner = StructuredLearner(arm.nominal, ROUGH, bases_for("RRRRRR"))
        learner.learn(*arm.pairs(rng, 75, 0.01))
        q = random_q(rng, "RRRRRR", 200, 80)
        estimate = learner.estimate(q)
        off = np.abs(estimate.x - arm.real.positions(q)) / estimate.sigma
        inside.append(np.array([(off < 1.0).mean(), (off < 1.96).mean()]))
    one, two = np.mean(inside, axis=0)
    assert 0.6 < one < 0.8
    assert 0.88 < two < 0.98
