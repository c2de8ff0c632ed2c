from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import random_chain, random_q
from scipy.spatial.transform import Rotation

from kbmaps import ChainParameters, ChainTolerances, SettingError
from kbmaps.rotations import rotation_vector

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=1, max_size=6)


def random_change(rng: np.random.Generator, parameters: ChainParameters, size: float) -> np.ndarray:
    return size * rng.normal(size=parameters.size)


@given(seed=seeds, kinds=kinds, size=st.sampled_from([0.0, 1e-5, 0.02, 0.5]))
def test_the_jacobian_is_the_derivative_of_the_positions(seed, kinds, size):
    rng = np.random.default_rng(seed)
    parameters = ChainParameters(random_chain(rng, kinds))
    change, q = random_change(rng, parameters, size), random_q(rng, kinds, 4, 170)
    x, jacobian = parameters.linearised(change, q)
    step = 1e-5
    measured = np.empty_like(jacobian)
    for column, unit in enumerate(np.eye(parameters.size)):
        ahead, behind = (parameters.positions(change + sign * step * unit, q) for sign in (1, -1))
        measured[..., column] = (ahead - behind) / (2 * step)
    np.testing.assert_allclose(jacobian, measured, rtol=0, atol=2e-8)
    np.testing.assert_allclose(x, parameters.positions(change, q), rtol=0, atol=1e-13)


@given(seed=seeds, kinds=kinds, size=st.sampled_from([0.0, 0.02, 0.5]))
def test_changed_chain_has_positions_of_the_parameter_change(seed, kinds, size):
    rng = np.random.default_rng(seed)
    parameters = ChainParameters(random_chain(rng, kinds))
    change, q = random_change(rng, parameters, size), random_q(rng, kinds, 5, 180)
    np.testing.assert_allclose(parameters.chain(change).positions(q), parameters.positions(change, q), atol=1e-12)


def test_no_change_gives_the_reference_back():
    rng = np.random.default_rng(3)
    chain = random_chain(rng, "RRPR")
    parameters = ChainParameters(chain)
    np.testing.assert_allclose(parameters.chain(np.zeros(parameters.size)).fixed, chain.fixed, atol=1e-14)


@given(seed=seeds, joints=st.integers(2, 7))
def test_positions_identify_four_parameters_per_joint_plus_tool(seed, joints):
    rng = np.random.default_rng(seed)
    parameters = ChainParameters(random_chain(rng, "R" * joints))
    q = random_q(rng, "R" * joints, 100, 170)
    _, jacobian = parameters.linearised(np.zeros(parameters.size), q)
    singular = np.linalg.svd(jacobian.reshape(300, -1), compute_uv=False)
    assert (singular > 1e-10 * singular[0]).sum() == 4 * joints + 3


@given(seed=seeds, angle=st.floats(0.0, np.pi))
def test_the_rotation_vector_gives_its_rotation_back(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    rotation = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    found = Rotation.from_rotvec(rotation_vector(rotation)).as_matrix()
    np.testing.assert_allclose(found, rotation, atol=1e-12)


def test_every_parameter_has_a_name_of_its_own():
    parameters = ChainParameters(random_chain(np.random.default_rng(0), "RPR"))
    assert len(set(parameters.names())) == parameters.size


def test_prismatic_axis_shift_is_fixed_at_any_tolerance():
    parameters = ChainParameters(random_chain(np.random.default_rng(0), "RP"))
    std = parameters.standard_deviations(ChainTolerances(points=0.01))
    np.testing.assert_array_equal(std[parameters.shifts], [0.01, 0.01, 0.0, 0.0])


@pytest.mark.parametrize("wrong", [-1.0, float("nan")])
def test_invalid_tolerance_is_refused_by_its_name(wrong):
    with pytest.raises(SettingError, match="tool"):
        ChainTolerances(tool=wrong)
