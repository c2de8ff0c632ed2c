from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, literal_weights, random_chain, random_map, random_q

from kbmaps import BasisError, JointBasis, KBMap, NonFiniteError, ShapeError, prediction_errors

pytestmark = pytest.mark.usefixtures("kernel_path")

kinds = st.text("RP", min_size=1, max_size=5)
seeds = st.integers(0, 2**32 - 1)


def bernstein_bases(joint_kinds: str, alpha: float = 1.0) -> list[JointBasis]:
    return [JointBasis.bernstein(alpha) if kind == "R" else JointBasis.prismatic(-0.3, 0.3) for kind in joint_kinds]


@given(joint_kinds=kinds, seed=seeds)
def test_prediction_is_the_weight_vector_times_the_net(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    kbmap = random_map(rng, bases_for(joint_kinds))
    q = random_q(rng, joint_kinds, 5, 170)
    expected = kbmap.weights(q) @ kbmap.net.reshape(3, -1).T
    np.testing.assert_allclose(kbmap.predict(q), expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max()))


@given(joint_kinds=kinds, seed=seeds)
def test_one_configuration_is_predicted_as_in_a_batch(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    kbmap = random_map(rng, bases_for(joint_kinds))
    q = random_q(rng, joint_kinds, 3, 170)
    one_by_one = np.stack([kbmap.predict(row) for row in q])
    np.testing.assert_allclose(kbmap.predict(q), one_by_one, rtol=0, atol=1e-13 * max(1.0, np.abs(one_by_one).max()))


def test_a_large_batch_is_predicted_row_by_row():
    rng = np.random.default_rng(1)
    kbmap = random_map(rng, bases_for("RR"))
    q = random_q(rng, "RR", 10_000, 170)
    np.testing.assert_allclose(kbmap.predict(q)[9_999], kbmap.predict(q[9_999]), rtol=1e-12)


def test_an_empty_batch_gives_an_empty_answer():
    kbmap = random_map(np.random.default_rng(1), bases_for("RR"))
    assert kbmap.predict(np.empty((0, 2))).shape == (0, 3)
    assert kbmap.jacobian(np.empty((0, 2))).shape == (0, 3, 2)


@given(seed=seeds, alpha=st.floats(0.3, 1.35), joints=st.integers(1, 4))
def test_the_weight_vector_is_that_of_equation_15(seed, alpha, joints):
    q = np.random.default_rng(seed).uniform(-2.5, 2.5, joints)
    kbmap = random_map(np.random.default_rng(seed), [JointBasis.bernstein(alpha)] * joints)
    literal = literal_weights(q, alpha)
    np.testing.assert_allclose(kbmap.weights(q), literal, rtol=0, atol=1e-10 * np.abs(literal).max())


@given(seed=seeds, joint=st.integers(0, 2), alpha=st.floats(0.3, 1.35))
def test_isoparametric_curves_are_ellipses_with_the_papers_weights(seed, joint, alpha):
    """One joint moving traces (Σ γ_i b_i B_i²)/(Σ γ_i B_i²) with γ = (1, cos α, 1): an ellipse, eq. (8)."""
    rng = np.random.default_rng(seed)
    kbmap = random_map(rng, [JointBasis.bernstein(alpha)] * 3)
    q = np.tile(rng.uniform(-3, 3, 3), (9, 1))
    q[:, joint] = np.linspace(-2.8, 2.8, 9)
    others = [kbmap.bases[k].weights(q[0, k]) for k in range(3) if k != joint]
    control = np.einsum("oimn,m,n->oi", np.moveaxis(kbmap.net, joint + 1, 1), *others)
    tau = np.tan(q[:, joint] / 2) / (2 * math.tan(alpha / 2)) + 0.5
    bernstein = np.stack([(1 - tau) ** 2, 2 * tau * (1 - tau), tau**2]) * np.array([[1], [math.cos(alpha)], [1]])
    rational = (control @ bernstein / bernstein.sum(axis=0)).T
    np.testing.assert_allclose(kbmap.predict(q), rational, rtol=0, atol=1e-9 * np.abs(control).max())


@given(seed=seeds)
def test_predictions_at_plus_and_minus_pi_agree(seed):
    rng = np.random.default_rng(seed)
    kbmap = random_chain(rng, "RRRRR").to_kbmap(bernstein_bases("RRRRR"))
    q = rng.choice([-math.pi, math.pi], 5)
    np.testing.assert_allclose(kbmap.predict(q), kbmap.predict(-q), rtol=0, atol=1e-12)


def test_ten_joints_at_pi_do_not_overflow():
    kbmap = KBMap((JointBasis.bernstein(1.0),) * 10, np.ones((3, *[3] * 10)))
    np.testing.assert_allclose(kbmap.predict(np.full(10, math.pi)), 1.0, rtol=1e-9)


@given(joint_kinds=kinds, seed=seeds)
def test_the_jacobian_agrees_with_finite_differences(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joint_kinds)
    kbmap = chain.to_kbmap(bases_for(joint_kinds))
    q = random_q(rng, joint_kinds, 1, 170)[0]
    step = 1e-6
    moves = step * np.eye(len(q))
    slopes = (kbmap.predict(q + moves) - kbmap.predict(q - moves)).T / (2 * step)
    np.testing.assert_allclose(kbmap.jacobian(q), slopes, rtol=0, atol=1e-8)


@given(joint_kinds=kinds, seed=seeds, alpha=st.floats(0.5, 1.3))
def test_a_change_of_basis_leaves_predictions(joint_kinds, seed, alpha):
    rng = np.random.default_rng(seed)
    kbmap = random_chain(rng, joint_kinds).to_kbmap(bases_for(joint_kinds))
    q = random_q(rng, joint_kinds, 20, 170)
    changed = kbmap.in_basis(bernstein_bases(joint_kinds, alpha))
    np.testing.assert_allclose(changed.predict(q), kbmap.predict(q), rtol=0, atol=1e-11)


def test_outer_control_points_are_the_curve_ends():
    chain = random_chain(np.random.default_rng(3), "R")
    kbmap = chain.to_kbmap(bases_for("R", 80))
    alpha = kbmap.bases[0].to_bernstein().parameters[0]
    expected = chain.positions([[-alpha], [alpha]])
    np.testing.assert_allclose(kbmap.control_points[[0, 2]], expected, atol=1e-12)


def test_the_net_cannot_be_changed_from_outside():
    net = np.ones((3, 3))
    kbmap = KBMap((JointBasis.trigonometric(),), net)
    net[:] = 5
    assert kbmap.net.max() == 1.0
    with pytest.raises(ValueError, match="read-only"):
        kbmap.net[0, 0] = 2


def test_maps_that_differ_have_different_digests():
    one, other = (random_map(np.random.default_rng(seed), bases_for("RR")) for seed in (1, 2))
    assert one.digest != other.digest
    assert one.digest == KBMap(one.bases, one.net, {"note": "same map"}).digest


def test_orientation_is_refused_where_only_positions_were_learnt():
    with pytest.raises(ShapeError, match="orientation"):
        random_map(np.random.default_rng(1), bases_for("R")).orientation([0.0])


@pytest.mark.parametrize("q", [np.zeros(2), np.zeros((4, 2)), np.zeros((1, 1, 3)), np.float64(0.0)])
def test_joint_vectors_of_the_wrong_length_are_refused(q):
    kbmap = random_map(np.random.default_rng(1), bases_for("RRR"))
    for method in (kbmap.predict, kbmap.jacobian, kbmap.weights):
        with pytest.raises(ShapeError):
            method(q)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_joint_values_that_are_not_finite_are_refused(bad):
    kbmap = random_map(np.random.default_rng(1), bases_for("RR"))
    for q in ([0.0, bad], [[0.0, bad]]):
        with pytest.raises(NonFiniteError):
            kbmap.predict(q)


def test_a_net_of_the_wrong_shape_is_refused():
    with pytest.raises(ShapeError):
        KBMap((JointBasis.trigonometric(),), np.ones((3, 2)))
    with pytest.raises(ShapeError):
        KBMap((JointBasis.trigonometric(),), np.ones((4, 3)))


def test_a_net_with_nan_is_refused():
    with pytest.raises(NonFiniteError):
        KBMap((JointBasis.trigonometric(),), np.full((3, 3), math.nan))


def test_a_map_without_joints_is_refused():
    with pytest.raises(BasisError):
        KBMap((), np.ones(3))


def test_prediction_errors_need_one_position_a_configuration():
    kbmap = random_map(np.random.default_rng(1), bases_for("R"))
    with pytest.raises(ShapeError):
        prediction_errors(kbmap, [[0.0], [1.0]], [[0.0, 0.0, 0.0]])
