"""Noise of single pairs is attributed to the camera and to each joint's reading."""

from __future__ import annotations

import numpy as np
import pytest

from kbmaps import WhiteNoise
from kbmaps.variance_components import inverse_roots

PAIRS, JOINTS = 1500, 4
TICK = 2.0 * np.pi / 4096


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


@pytest.fixture
def derivatives(rng: np.random.Generator) -> np.ndarray:
    """Return the derivatives of an arm about a metre long, shape (PAIRS, 3, JOINTS)."""
    return 0.5 * rng.normal(size=(PAIRS, 3, JOINTS))


@pytest.fixture
def covariances(rng: np.random.Generator) -> np.ndarray:
    """Return covariances of a camera, 25 times as large along its view, shape (PAIRS, 3, 3)."""
    view = rng.normal(size=(PAIRS, 3))
    view /= np.linalg.norm(view, axis=1)[:, None]
    return 1e-8 * (np.eye(3) + 24.0 * view[:, :, None] * view[:, None, :])


def drawn(covariances: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.matvec(np.linalg.cholesky(covariances), rng.normal(size=(PAIRS, 3)))


def test_encoder_ticks_are_recovered_within_30_percent(rng, derivatives, covariances) -> None:
    ticks = TICK * np.array([1.0, 2.0, 4.0, 1.0])
    read_wrongly = rng.uniform(-0.5, 0.5, (PAIRS, JOINTS)) * ticks
    errors = drawn(covariances, rng) + np.matvec(derivatives, read_wrongly)
    found = WhiteNoise.of(errors, covariances, derivatives)
    np.testing.assert_allclose(np.sqrt(12.0 * found.joints), ticks, rtol=0.3)


@pytest.mark.parametrize("claimed", [1.0, 2.0, 5.0])
def test_overconfident_camera_covariance_is_scaled_up(claimed, rng, derivatives, covariances) -> None:
    found = WhiteNoise.of(drawn(claimed * covariances, rng), covariances, derivatives)
    assert found.claimed == pytest.approx(claimed, rel=0.15)


def test_camera_covariance_is_never_scaled_down(rng, derivatives, covariances) -> None:
    """Check that errors shared by neighbours do not show in their differences."""
    assert WhiteNoise.of(drawn(0.1 * covariances, rng), covariances, derivatives).claimed == 1.0


@pytest.mark.parametrize("sigma_m", [1e-3, 5e-3, 2e-2])
def test_round_noise_is_not_blamed_on_joints(sigma_m, rng, derivatives) -> None:
    """Joints that turn in all directions scatter the marker in all directions as well."""
    round_ = np.broadcast_to(sigma_m**2 * np.eye(3), (PAIRS, 3, 3))
    found = WhiteNoise.of(drawn(round_, rng), round_, derivatives)
    np.testing.assert_array_equal(found.joints, 0.0)


def test_errors_shared_by_neighbours_are_not_noise(rng, derivatives, covariances) -> None:
    errors = drawn(covariances, rng)
    shared = 0.01 * np.sin(np.arange(PAIRS)[:, None] / 200.0 + np.arange(3))
    alone, beside = (WhiteNoise.of(each, covariances, derivatives) for each in (errors, errors + shared))
    np.testing.assert_allclose(
        beside.covariances(covariances, derivatives), alone.covariances(covariances, derivatives), rtol=0.2, atol=2e-9
    )


def test_one_pair_in_a_hundred_may_be_anywhere(rng, derivatives, covariances) -> None:
    errors = drawn(covariances, rng)
    errors[::100] += 0.1
    found = WhiteNoise.of(errors, covariances, derivatives).covariances(covariances, derivatives)
    whitened = np.matvec(inverse_roots(found), errors)[1:100]
    assert 0.5 < float(np.square(whitened).mean()) < 1.3


def test_of_few_pairs_nothing_is_learnt(rng, derivatives, covariances) -> None:
    few = slice(10 * JOINTS)
    found = WhiteNoise.of(drawn(covariances, rng)[few], covariances[few], derivatives[few])
    np.testing.assert_array_equal(found.covariances(covariances, derivatives), covariances)


def test_zero_errors_have_a_positive_definite_covariance(derivatives, covariances) -> None:
    found = WhiteNoise.of(np.zeros((PAIRS, 3)), covariances, derivatives).covariances(covariances, derivatives)
    assert (np.linalg.eigvalsh(found) > 0.0).all()
