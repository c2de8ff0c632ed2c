from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from kbmaps import NonFiniteError, SettingError, ShapeError, resolved_rates

seeds = st.integers(0, 2**32 - 1)


@given(seed=seeds, joints=st.integers(1, 8), tasks=st.sampled_from([3, 6]), damping=st.floats(1e-3, 1.0))
def test_rates_without_limits_are_the_damped_least_squares_solution(seed, joints, tasks, damping):
    rng = np.random.default_rng(seed)
    J, v, preferred, scale = (
        rng.normal(size=(tasks, joints)), rng.normal(size=tasks), rng.normal(size=joints), rng.uniform(0.1, 3, joints)
    )  # fmt: skip
    stacked = np.concatenate([J, damping * np.diag(1 / scale)])
    expected = np.linalg.lstsq(stacked, np.concatenate([v, damping * preferred / scale]), rcond=None)[0]
    found = resolved_rates(J, v, damping=damping, preferred=preferred, scale=scale)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@given(seed=seeds)
def test_a_preferred_rate_of_a_redundant_arm_does_not_disturb_the_velocity(seed):
    rng = np.random.default_rng(seed)
    J, v = rng.normal(size=(3, 7)), rng.normal(size=3)
    u = resolved_rates(J, v, damping=1e-6, preferred=rng.normal(size=7))
    np.testing.assert_allclose(J @ u, v, atol=1e-6)


@given(seed=seeds, joints=st.integers(1, 12), damping=st.floats(0.01, 1.0))
def test_rates_within_limits_are_the_best_there_are(seed, joints, damping):
    """Compare with an independent solver."""
    rng = np.random.default_rng(seed)
    J, v, preferred = rng.normal(size=(3, joints)), rng.normal(size=3), 0.3 * rng.normal(size=joints)
    low, high = -rng.uniform(0.01, 0.5, joints), rng.uniform(0.01, 0.5, joints)
    u = resolved_rates(J, v, damping=damping, low=low, high=high, preferred=preferred)
    stacked, wanted = np.concatenate([J, damping * np.eye(joints)]), np.concatenate([v, damping * preferred])
    best = lsq_linear(stacked, wanted, (low, high), method="bvls", tol=1e-14, max_iter=1000)
    assert ((low <= u) & (u <= high)).all()
    np.testing.assert_allclose(u, best.x, atol=1e-7)


def test_other_joints_make_up_for_one_that_is_held():
    J = np.array([[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    u = resolved_rates(J, [1.0, 0.0, 0.0], damping=1e-6, low=[-1, -1], high=[0.2, 1])
    np.testing.assert_allclose(u, [0.2, 0.8], atol=1e-9)


def test_rates_stay_bounded_where_the_jacobian_loses_rank():
    J = np.array([[1.0, 1.0], [1.0, 1.0], [0.0, 1e-12]])
    u = resolved_rates(J, [0.0, 0.0, 1.0], damping=0.01)
    assert np.abs(u).max() < 1e-6
    assert np.isfinite(resolved_rates(np.zeros((3, 2)), [1.0, 0.0, 0.0], damping=1e-200)).all()


def test_bad_input_is_refused():
    J = np.eye(3)
    with pytest.raises(SettingError, match="damping"):
        resolved_rates(J, [1, 0, 0], damping=0.0)
    with pytest.raises(SettingError, match="low"):
        resolved_rates(J, [1, 0, 0], damping=1.0, low=[1, 0, 0], high=[0, 1, 1])
    with pytest.raises(SettingError, match="scale"):
        resolved_rates(J, [1, 0, 0], damping=1.0, scale=[1, 0, 0])
    with pytest.raises(ShapeError):
        resolved_rates(J, [1, 0], damping=1.0)
    with pytest.raises(ShapeError):
        resolved_rates(np.ones(3), [1, 0, 0], damping=1.0)
    with pytest.raises(NonFiniteError):
        resolved_rates(np.full((3, 3), np.nan), [1, 0, 0], damping=1.0)
