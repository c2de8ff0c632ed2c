from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, random_chain, random_q

from kbmaps import BasisError, JointBasis, ModelFormatError, NonFiniteError, ShapeError, TensorTrain

chains = st.tuples(st.text("RP", min_size=1, max_size=9), st.integers(0, 10_000))
small_chains = st.tuples(st.text("RP", min_size=1, max_size=5), st.integers(0, 10_000))


def random_train(kinds: str, seed: int) -> TensorTrain:
    """Return random cores, like those of a learner and unlike any chain's."""
    bases = bases_for(kinds)
    cores = 0.5 * np.random.default_rng(seed).normal(size=(len(kinds), 3, 3, 4))
    for k, basis in enumerate(bases):
        cores[k, basis.size :] = 0.0
    return TensorTrain(bases, cores)


STORED = random_train("RPR", 7).to_bytes()


@given(chains)
def test_the_train_of_a_chain_is_the_chain(case):
    kinds, seed = case
    rng = np.random.default_rng(seed)
    chain, q = random_chain(rng, kinds), random_q(rng, kinds, 20, 180)
    assert np.abs(TensorTrain.from_chain(chain, bases_for(kinds)).predict(q) - chain.positions(q)).max() < 1e-12


@given(small_chains)
def test_its_control_net_gives_the_same_positions(case):
    kinds, seed = case
    train, q = random_train(kinds, seed), random_q(np.random.default_rng(seed), kinds, 20, 150)
    assert np.allclose(train.to_kbmap().predict(q), train.predict(q), rtol=1e-11, atol=1e-11)


@given(small_chains)
def test_net_via_train_equals_net_of_chain(case):
    kinds, seed = case
    chain, bases = random_chain(np.random.default_rng(seed), kinds), bases_for(kinds)
    assert np.allclose(TensorTrain.from_chain(chain, bases).to_kbmap().net, chain.to_kbmap(bases).net, atol=1e-12)


@given(small_chains)
def test_the_jacobian_is_that_of_finite_differences(case):
    kinds, seed = case
    train, q = random_train(kinds, seed), random_q(np.random.default_rng(seed), kinds, 1, 80)[0]
    step = 1e-6
    moved = [(train.predict(q + step * axis) - train.predict(q - step * axis)) / (2 * step) for axis in np.eye(len(q))]
    assert np.allclose(train.jacobian(q), np.transpose(moved), rtol=1e-6, atol=1e-7)


@given(small_chains)
def test_affine_gauge_change_between_cores_keeps_predictions(case):
    kinds, seed = case
    kinds += "R"
    rng = np.random.default_rng(seed)
    train, q = random_train(kinds, seed), random_q(rng, kinds, 20, 150)
    linear, shift = np.eye(3) + 0.3 * rng.normal(size=(3, 3)), rng.normal(size=3)
    bond = int(rng.integers(1, len(kinds)))
    cores = train.cores.copy()
    # Ahead of the bond B ∘ A, behind it A⁻¹ ∘ B; a constant reaches a core through its constant function's slice.
    ahead, behind, inverse = cores[bond - 1], cores[bond], np.linalg.inv(linear)
    ahead[:, :, 3] += ahead[:, :, :3] @ shift
    ahead[:, :, :3] = ahead[:, :, :3] @ linear
    behind[0, :, 3] -= shift
    cores[bond] = inverse @ behind
    assert np.allclose(TensorTrain(train.bases, cores).predict(q), train.predict(q), rtol=1e-9, atol=1e-9)


def test_a_change_of_basis_moves_nothing():
    train, q = random_train("RPR", 3), random_q(np.random.default_rng(3), "RPR", 20, 150)
    other = train.in_basis([JointBasis.bernstein(1.0), JointBasis.prismatic(-1, 1), JointBasis.trigonometric()])
    assert np.allclose(other.predict(q), train.predict(q), atol=1e-12)


def test_control_net_in_bernstein_bases_keeps_predictions():
    train, q = random_train("RPR", 3), random_q(np.random.default_rng(3), "RPR", 20, 150)
    other = train.in_basis([JointBasis.bernstein(1.0), JointBasis.prismatic(-1, 1), JointBasis.trigonometric()])
    assert np.allclose(other.to_kbmap().predict(q), train.predict(q), atol=1e-12)


def test_single_prediction_equals_batch_prediction():
    train, q = random_train("RRPR", 1), np.array([0.1, -0.7, 0.2, 1.4])
    assert np.array_equal(train.predict(q), train.predict(q[None])[0])


def test_thirty_joints_need_no_more_than_their_cores():
    kinds = "R" * 30
    rng = np.random.default_rng(30)
    chain, q = random_chain(rng, kinds), random_q(rng, kinds, 5, 170)
    train = TensorTrain.from_chain(chain, bases_for(kinds))
    assert np.abs(train.predict(q) - chain.positions(q)).max() < 1e-12
    assert len(train.to_bytes()) < 8 * 36 * 30 + 4000


@given(chains)
def test_train_round_trips_through_bytes_bit_for_bit(case):
    train = random_train(*case)
    back = TensorTrain.from_bytes(train.to_bytes())
    assert back.bases == train.bases
    assert back.cores.tobytes() == train.cores.tobytes()


@given(position=st.integers(0, len(STORED) - 1), flip=st.integers(1, 255))
def test_a_single_changed_byte_is_noticed(position, flip):
    damaged = bytearray(STORED)
    damaged[position] ^= flip
    with pytest.raises(ModelFormatError):
        TensorTrain.from_bytes(bytes(damaged))


@given(length=st.integers(0, len(STORED) - 1))
def test_truncated_bytes_are_noticed(length):
    with pytest.raises(ModelFormatError):
        TensorTrain.from_bytes(STORED[:length])


def test_a_stored_map_of_another_kind_is_refused():
    with pytest.raises(ModelFormatError):
        TensorTrain.from_bytes(random_train("RR", 0).to_kbmap().to_bytes())


def test_third_slice_for_prismatic_joint_is_refused():
    with pytest.raises(BasisError, match="joint 2 is prismatic"):
        TensorTrain(bases_for("RP"), np.ones((2, 3, 3, 4)))


def test_revolute_basis_for_prismatic_joint_is_refused():
    with pytest.raises(BasisError, match="joint 1 of 1 is prismatic"):
        TensorTrain.from_chain(random_chain(np.random.default_rng(0), "P"), bases_for("R"))


def test_cores_of_another_shape_are_refused():
    with pytest.raises(ShapeError):
        TensorTrain(bases_for("RR"), np.zeros((2, 3, 4, 4)))


def test_cores_that_are_not_finite_are_refused():
    with pytest.raises(NonFiniteError):
        TensorTrain(bases_for("R"), np.full((1, 3, 3, 4), np.nan))


def test_arrays_of_a_train_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        random_train("RR", 0).cores[0, 0, 0, 0] = 1.0
