from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import random_chain, random_q
from scipy.spatial.transform import Rotation

from kbmaps import DegenerateDataError, NonFiniteError, RigidChain, SettingError, ShapeError, align

seeds = st.integers(0, 2**32 - 1)


def planted(rng: np.random.Generator, *, pose: bool, marker: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return an arbitrary instrument pose and a tool shift of up to 0.3 m."""
    T_measured_nominal = np.eye(4)
    if pose:
        T_measured_nominal[:3, :3] = Rotation.random(rng=rng).as_matrix()
        T_measured_nominal[:3, 3] = rng.uniform(-3, 3, 3)
    direction = rng.normal(size=3)
    shift = rng.uniform(0, 0.3) * direction / np.linalg.norm(direction) if marker else np.zeros(3)
    return T_measured_nominal, shift


@given(seed=seeds, pose=st.booleans(), marker=st.booleans(), joints=st.integers(4, 7))
def test_a_planted_pose_and_marker_are_recovered(seed, pose, marker, joints):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, "R" * joints)
    T, shift = planted(rng, pose=pose, marker=marker)
    q = random_q(rng, "R" * joints, 60, 90)
    x = chain.with_tool(shift).transformed(T).positions(q)
    fit = align(chain, q, x, pose_known=not pose, marker_known=not marker)
    np.testing.assert_allclose(fit.T_measured_nominal, T, rtol=0, atol=1e-7)
    np.testing.assert_allclose(fit.marker_shift, shift, rtol=0, atol=1e-7)
    assert fit.rms < 1e-8
    assert fit.inliers.all()


@given(seed=seeds, marker=st.booleans())
def test_a_tenth_of_gross_outliers_does_no_harm(seed, marker):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, "R" * 6)
    T, shift = planted(rng, pose=True, marker=marker)
    q = random_q(rng, "R" * 6, 200, 80)
    truth = chain.with_tool(shift).transformed(T)
    x = truth.positions(q) + 0.002 * rng.normal(size=(200, 3))
    wrong = rng.choice(200, 20, replace=False)
    x[wrong] += rng.uniform(0.1, 0.5, (20, 1)) * rng.choice([-1, 1], (20, 3))
    fit = align(chain, q, x, pose_known=False, marker_known=not marker, sigma=0.002)
    errors = np.linalg.norm(fit.chain.positions(q) - truth.positions(q), axis=1)
    assert errors.max() < 0.003
    assert not fit.inliers[wrong].any()
    assert fit.inliers.sum() == 180


def test_few_exact_pairs_are_all_inliers():
    """Three of five pairs could be fitted exactly in many ways; that must not make outliers of the other two."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        chain = random_chain(rng, "R" * 5)
        T, shift = planted(rng, pose=True, marker=True)
        q = random_q(rng, "R" * 5, 5, 60)
        x = chain.with_tool(shift).transformed(T).positions(q) + 0.001 * rng.normal(size=(5, 3))
        assert align(chain, q, x, pose_known=False, marker_known=False).inliers.all()


@pytest.mark.soak
def test_random_arms_are_aligned_in_99_percent():
    aligned = []
    for seed in range(500):
        rng = np.random.default_rng(seed)
        kinds = "R" * int(rng.integers(4, 8))
        chain = random_chain(rng, kinds)
        T, shift = planted(rng, pose=True, marker=True)
        q = random_q(rng, kinds, int(rng.integers(5, 60)), float(rng.choice([20, 30, 90])))
        x = chain.with_tool(shift).transformed(T).positions(q)
        aligned.append(align(chain, q, x, pose_known=False, marker_known=False).rms < 1e-7)
    assert np.mean(aligned) >= 0.99


def test_without_outliers_the_fit_is_plain_least_squares():
    rng = np.random.default_rng(3)
    chain = random_chain(rng, "R" * 6)
    q = random_q(rng, "R" * 6, 300, 80)
    x = chain.positions(q) + 0.005 * rng.normal(size=(300, 3))
    fit = align(chain, q, x, pose_known=False, marker_known=False)
    for _ in range(20):
        nudge = np.eye(4)
        nudge[:3, :3] = Rotation.from_rotvec(1e-4 * rng.normal(size=3)).as_matrix()
        nudge[:3, 3] = 1e-4 * rng.normal(size=3)
        other = fit.chain.with_tool(1e-4 * rng.normal(size=3)).transformed(nudge)
        assert np.sqrt(np.square(other.positions(q) - x).sum(axis=1).mean()) > fit.rms


def test_mirrored_points_are_fitted_by_proper_rotation():
    rng = np.random.default_rng(4)
    chain = random_chain(rng, "RRRR")
    q = random_q(rng, "RRRR", 50, 80)
    mirrored = chain.positions(q) * np.array([1.0, 1.0, -1.0])
    fit = align(chain, q, mirrored, pose_known=False, marker_known=True)
    assert np.linalg.det(fit.T_measured_nominal[:3, :3]) == pytest.approx(1.0)
    assert fit.rms > 0.01


def test_unidentifiable_marker_shift_stays_small():
    """All joints turn about z, so the heights of instrument and marker are not separately identifiable."""
    rng = np.random.default_rng(5)
    fixed = np.tile(np.eye(4), (3, 1, 1))
    fixed[1:, 0, 3] = 0.4
    chain = RigidChain(fixed, np.tile([0.0, 0.0, 1.0], (2, 1)), np.zeros(2, dtype=bool))
    q = random_q(rng, "RR", 40, 80)
    fit = align(chain, q, chain.positions(q) + np.array([0, 0, 0.1]), pose_known=False, marker_known=False)
    assert fit.rms < 1e-8
    assert abs(fit.marker_shift[2]) <= 0.1 + 1e-9


def test_known_pose_and_marker_stay_unchanged():
    rng = np.random.default_rng(6)
    chain = random_chain(rng, "RRR")
    q = random_q(rng, "RRR", 30, 80)
    x = chain.positions(q) + 0.01 * rng.normal(size=(30, 3))
    fit = align(chain, q, x, pose_known=True, marker_known=True)
    assert (fit.T_measured_nominal == np.eye(4)).all()
    assert (fit.marker_shift == 0).all()
    assert fit.rms == pytest.approx(np.sqrt(np.square(chain.positions(q) - x).sum(axis=1).mean()))


@pytest.mark.parametrize(
    ("pose_known", "marker_known", "needed"), [(True, False, 1), (False, True, 3), (False, False, 4)]
)
def test_too_few_pairs_error_states_number_needed(pose_known, marker_known, needed):
    chain = random_chain(np.random.default_rng(1), "RRR")
    n = needed - 1
    with pytest.raises(DegenerateDataError, match=f"at least {needed} pairs"):
        align(chain, np.zeros((n, 3)), np.zeros((n, 3)), pose_known=pose_known, marker_known=marker_known)


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_points_on_one_line_are_refused(spread):
    rng = np.random.default_rng(1)
    chain = random_chain(rng, "RRR")
    line = spread * np.linspace(0, 1, 10)[:, None] * np.array([1.0, 2.0, 3.0])
    with pytest.raises(DegenerateDataError, match="one line"):
        align(chain, random_q(rng, "RRR", 10, 80), line, pose_known=False, marker_known=True)


def test_bad_input_is_refused():
    chain = random_chain(np.random.default_rng(1), "RR")
    good = np.zeros((5, 2)), np.zeros((5, 3))
    with pytest.raises(ShapeError):
        align(chain, good[0], np.zeros((4, 3)), pose_known=True, marker_known=False)
    with pytest.raises(NonFiniteError):
        align(chain, good[0], np.full((5, 3), np.nan), pose_known=True, marker_known=False)
    with pytest.raises(SettingError, match="sigma"):
        align(chain, *good, pose_known=True, marker_known=False, sigma=0.0)
