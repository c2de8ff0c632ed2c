from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, literal_weights, random_chain, random_q

from kbmaps import BasisError, JointBasis, KBMap, NonFiniteError, ShapeError, SingularAlphaError

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=1, max_size=5)
alphas = st.floats(math.radians(20), math.radians(79)) | st.floats(math.radians(101), math.radians(150))


@given(joint_kinds=kinds, seed=seeds, alpha=alphas, orientation=st.booleans())
def test_another_alpha_afterwards_leaves_the_map(joint_kinds, seed, alpha, orientation):
    rng = np.random.default_rng(seed)
    kbmap = random_chain(rng, joint_kinds).to_kbmap(bases_for(joint_kinds), orientation=orientation)
    q = random_q(rng, joint_kinds, 20, 170)
    changed = kbmap.with_alpha(alpha, centre=rng.uniform(-1, 1, len(joint_kinds)))
    np.testing.assert_allclose(changed.predict(q), kbmap.predict(q), atol=1e-9)
    if orientation:
        np.testing.assert_allclose(changed.orientation(q), kbmap.orientation(q), atol=1e-9)


@given(seed=seeds, alpha=st.floats(0.4, 1.35))
def test_a_new_alpha_has_the_papers_weights(seed, alpha):
    """The control points for the new α, weighted as eq. (15) prints it, give the positions."""
    rng = np.random.default_rng(seed)
    kbmap = random_chain(rng, "RRR").to_kbmap(bases_for("RRR"))
    points = kbmap.with_alpha(alpha).control_points.reshape(-1, 3)
    q = rng.uniform(-2.5, 2.5, 3)
    np.testing.assert_allclose(literal_weights(q, alpha) @ points, kbmap.predict(q), atol=1e-8)


@given(joint_kinds=kinds, seed=seeds, one=st.floats(0.4, 1.35), other=st.floats(0.4, 1.35))
def test_there_and_back_gives_the_same_control_points(joint_kinds, seed, one, other):
    kbmap = random_chain(np.random.default_rng(seed), joint_kinds).to_kbmap(bases_for(joint_kinds)).with_alpha(one)
    back = kbmap.with_alpha(other).with_alpha(one)
    np.testing.assert_allclose(back.control_points, kbmap.control_points, atol=1e-8)


@given(joint_kinds=kinds, seed=seeds)
def test_map_round_trips_through_its_control_points(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    kbmap = random_chain(rng, joint_kinds).to_kbmap(bases_for(joint_kinds)).with_alpha(1.0)
    back = KBMap.from_control_points(kbmap.bases, kbmap.control_points)
    assert back.digest == kbmap.digest


def test_each_joint_may_have_its_own_alpha():
    kbmap = random_chain(np.random.default_rng(1), "RPR").to_kbmap(bases_for("RPR")).with_alpha([1.0, 0.5, 1.2], 0.1)
    assert [basis.parameters for basis in kbmap.bases] == [(1.0, 0.1), (-0.3, 0.3), (1.2, 0.1)]


def test_an_alpha_near_90_degrees_is_refused():
    kbmap = random_chain(np.random.default_rng(1), "RR").to_kbmap(bases_for("RR"))
    with pytest.raises(SingularAlphaError):
        kbmap.with_alpha(math.radians(90))
    with pytest.raises(ShapeError):
        kbmap.with_alpha([1.0, 1.0, 1.0])
    with pytest.raises(NonFiniteError):
        kbmap.with_alpha(math.nan)


def test_control_points_of_another_basis_are_refused():
    with pytest.raises(BasisError, match="joint 1"):
        KBMap.from_control_points(bases_for("R"), np.ones((3, 3)))
    with pytest.raises(ShapeError):
        KBMap.from_control_points([JointBasis.bernstein(1.0)], np.ones((3, 2)))
