from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import literal_joint_weights

from kbmaps import BasisError, JointBasis, SingularAlphaError, learning_bases

alphas = st.one_of(st.floats(5.0, 79.9), st.floats(100.1, 175.0)).map(math.radians)
angles = st.floats(-20.0, 20.0)
ranges = st.tuples(st.floats(-3.0, 3.0), st.floats(0.05, 7.0)).map(lambda t: (t[0], t[0] + t[1]))
revolute = st.one_of(
    st.builds(JointBasis.bernstein, alphas, st.floats(-3.0, 3.0)),
    st.just(JointBasis.trigonometric()),
    ranges.map(lambda r: JointBasis.orthonormal(*r)),
)
prismatic = st.one_of(
    ranges.map(lambda r: JointBasis.prismatic(*r)), ranges.map(lambda r: JointBasis.prismatic_orthonormal(*r))
)


@given(theta=st.floats(-3.1, 3.1), alpha=alphas)
def test_singularity_free_weights_match_equations_9_and_10(theta, alpha):
    weights = JointBasis.bernstein(alpha).weights(theta)
    literal = literal_joint_weights(theta, alpha)
    np.testing.assert_allclose(weights, literal, rtol=1e-9, atol=1e-9 * np.abs(literal).max())


@given(theta=angles, alpha=alphas, centre=st.floats(-3.0, 3.0))
def test_bernstein_weights_sum_to_one(theta, alpha, centre):
    weights = JointBasis.bernstein(alpha, centre).weights(theta)
    assert weights.sum() == pytest.approx(1.0, abs=1e-13 * max(1.0, np.abs(weights).max()))


@given(q=st.floats(-5.0, 5.0), ends=ranges)
def test_prismatic_weights_sum_to_one(q, ends):
    assert JointBasis.prismatic(*ends).weights(q).sum() == pytest.approx(1.0, abs=1e-12)


@given(alpha=alphas)
def test_nothing_happens_at_half_a_turn(alpha):
    basis = JointBasis.bernstein(alpha)
    np.testing.assert_allclose(basis.weights(math.pi), basis.weights(-math.pi), rtol=1e-12, atol=1e-12)


@given(alpha=alphas, centre=st.floats(-3.0, 3.0))
def test_outer_control_points_lie_at_plus_minus_alpha(alpha, centre):
    basis = JointBasis.bernstein(alpha, centre)
    ends = basis.weights(np.array([centre - alpha, centre + alpha]))
    np.testing.assert_allclose(ends, [[1, 0, 0], [0, 0, 1]], atol=1e-9)


@given(basis=st.one_of(revolute, prismatic), theta=st.floats(-3.5, 3.5))
def test_weights_are_the_monomials_times_the_matrix(basis, theta):
    monomials = [1.0, theta] if basis.is_prismatic else [1.0, math.cos(theta), math.sin(theta)]
    scale = np.abs(basis.matrix).max()
    np.testing.assert_allclose(basis.weights(theta), monomials @ basis.matrix, rtol=0, atol=1e-13 * scale * 10)


@given(basis=st.one_of(revolute, prismatic), theta=st.floats(-3.5, 3.5))
def test_derivatives_agree_with_central_differences(basis, theta):
    step = 1e-4
    slope = (basis.weights(theta + step) - basis.weights(theta - step)) / (2 * step)
    scale = np.abs(basis.matrix).max()
    np.testing.assert_allclose(basis.derivatives(theta), slope, rtol=0, atol=1e-7 * scale)


@given(data=st.data(), coefficients=st.lists(st.floats(-1, 1), min_size=3, max_size=3), theta=st.floats(-3.5, 3.5))
def test_a_change_of_basis_keeps_the_function(data, coefficients, theta):
    kind = data.draw(st.sampled_from([revolute, prismatic]))
    old, new = data.draw(kind), data.draw(kind)
    values = np.array(coefficients[: old.size])
    changed = old.change_to(new) @ values
    tolerance = 1e-14 * np.linalg.cond(new.matrix) * np.abs(old.matrix).max() * np.abs(new.matrix).max() + 1e-12
    assert new.weights(theta) @ changed == pytest.approx(float(old.weights(theta) @ values), abs=100 * tolerance)


@given(ends=ranges, scale=st.floats(0.1, 2.0), slides=st.booleans())
def test_the_learning_basis_is_orthogonal_over_its_range(ends, scale, slides):
    (basis,) = learning_bases([ends[0]], [ends[1]], [slides], scale)
    turn = 2 * math.pi
    high = ends[1] if slides else min(ends[1], 0.5 * sum(ends) + math.pi)
    low = ends[0] if slides else max(ends[0], high - turn)
    samples = low + (np.arange(4000) + 0.5) / 4000 * (high - low)
    weights = basis.weights(samples)
    gram = weights.T @ weights / len(samples)
    np.testing.assert_allclose(gram, np.diag([1.0] + [scale**2] * (basis.size - 1)), atol=1e-3)


@pytest.mark.parametrize("alpha_deg", [80.0, 85.0, 90.0, 95.0, 100.0])
def test_alpha_from_80_to_100_degrees_is_refused(alpha_deg):
    with pytest.raises(SingularAlphaError, match="choose"):
        JointBasis.bernstein(math.radians(alpha_deg))


@pytest.mark.parametrize("alpha_deg", [-10.0, 0.0, 180.0, 400.0])
def test_alpha_outside_half_a_turn_is_refused(alpha_deg):
    with pytest.raises(BasisError):
        JointBasis.bernstein(math.radians(alpha_deg))


@pytest.mark.parametrize("ends", [(0.5, 0.5), (1.0, 0.0), (0.0, math.nan), (0.0, math.inf)])
def test_an_empty_range_is_refused(ends):
    with pytest.raises(BasisError):
        JointBasis.orthonormal(*ends)


def test_a_prismatic_basis_cannot_replace_a_revolute_one():
    with pytest.raises(BasisError, match="prismatic"):
        JointBasis.prismatic(0, 1).change_to(JointBasis.trigonometric())


def test_as_many_low_as_high_ends_are_needed():
    with pytest.raises(BasisError, match="one range a joint"):
        learning_bases([0.0, 0.0], [1.0])
