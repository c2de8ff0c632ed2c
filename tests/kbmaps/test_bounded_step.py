from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from kbmaps.inverse.descent import bounded_step

seeds = st.integers(0, 2**32 - 1)


@given(seed=seeds, joints=st.integers(1, 8), tasks=st.sampled_from([3, 6]), damping=st.floats(1e-3, 1.0))
def test_without_limits_it_is_damped_least_squares(seed, joints, tasks, damping):
    rng = np.random.default_rng(seed)
    J, e, preferred = rng.normal(size=(tasks, joints)), rng.normal(size=tasks), rng.normal(size=joints)
    scale, far = rng.uniform(0.1, 3, joints), np.full(joints, np.inf)
    stacked = np.concatenate([J, damping * np.diag(1 / scale)])
    expected = np.linalg.lstsq(stacked, np.concatenate([e, damping * preferred / scale]), rcond=None)[0]
    np.testing.assert_allclose(bounded_step(J, e, damping**2, (-far, far), preferred, scale), expected, atol=1e-9)


@given(seed=seeds, joints=st.integers(1, 12), damping=st.floats(0.01, 1.0))
def test_within_limits_it_is_the_best_there_is(seed, joints, damping):
    """Compare with an independent solver."""
    rng = np.random.default_rng(seed)
    J, e, preferred = rng.normal(size=(3, joints)), rng.normal(size=3), 0.3 * rng.normal(size=joints)
    low, high = -rng.uniform(0.01, 0.5, joints), rng.uniform(0.01, 0.5, joints)
    u = bounded_step(J, e, damping**2, (low, high), preferred, np.ones(joints))
    stacked, wanted = np.concatenate([J, damping * np.eye(joints)]), np.concatenate([e, damping * preferred])
    best = lsq_linear(stacked, wanted, (low, high), method="bvls", tol=1e-14, max_iter=1000)
    assert ((low <= u) & (u <= high)).all()
    np.testing.assert_allclose(u, best.x, atol=1e-7)
