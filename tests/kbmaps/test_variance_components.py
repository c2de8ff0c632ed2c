"""Covariances of errors, found as sums of parts of known shape."""

from __future__ import annotations

import numpy as np
import pytest

from kbmaps.arrays import FloatArray
from kbmaps.variance_components import error_covariances, is_anisotropic

PAIRS = 400


def drawn(
    rng: np.random.Generator, depth: float, reading: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return errors (n, 3), their covariances, those of a camera with this depth alone, and derivatives by readings."""
    sight = rng.normal(size=(PAIRS, 3))
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    camera = np.eye(3) + (depth**2 - 1.0) * sight[:, :, None] * sight[:, None, :]
    readings = rng.normal(size=(PAIRS, 3, 2))
    whole = camera + reading**2 * readings @ readings.mT
    return np.matvec(np.linalg.cholesky(whole), rng.normal(size=(PAIRS, 3))), whole, camera, readings


def with_depth(camera: FloatArray, factor: float) -> FloatArray:
    values, axes = np.linalg.eigh(camera)
    values[:, 2] *= factor**2
    return (axes * values[:, None, :]) @ axes.mT


@pytest.mark.parametrize("factor", [1.0 / 3.0, 1.0, 3.0])
@pytest.mark.parametrize("reading", [0.0, 2.0])
@pytest.mark.parametrize("size", [0.1, 10.0])
def test_the_stated_shape_is_corrected_by_the_errors(factor: float, reading: float, size: float) -> None:
    errors, whole, camera, readings = drawn(np.random.default_rng(0), 8.0, reading)
    found = error_covariances(errors, size * with_depth(camera, factor), readings)
    mismatch = np.linalg.eigvals(np.linalg.solve(whole, found)).real
    assert 0.75 < np.median(mismatch) < 1.3
    assert np.sqrt(np.square(np.log(mismatch)).mean()) < 0.35


def test_outliers_do_not_change_it() -> None:
    errors, whole, camera, readings = drawn(np.random.default_rng(1), 8.0, 0.0)
    errors[::20] *= 100.0
    found = error_covariances(errors, camera, readings)
    assert np.median(np.linalg.eigvals(np.linalg.solve(whole, found)).real) < 1.5


@pytest.mark.parametrize("one_in", [10, 5, 3])
def test_many_depth_outliers_do_not_inflate_covariance(one_in: int) -> None:
    errors, whole, camera, readings = drawn(np.random.default_rng(2), 8.0, 0.0)
    errors[::one_in] += 400.0 * np.linalg.eigh(camera)[1][::one_in, :, 2]
    found = error_covariances(errors, camera, readings)
    assert np.linalg.eigvals(np.linalg.solve(whole, found)).real.max() < 2.0


def test_a_covariance_of_zeros_counts_as_missing() -> None:
    errors, _, camera, readings = drawn(np.random.default_rng(4), 8.0, 0.0)
    third = np.arange(PAIRS)[:, None, None] % 3 == 0
    zeros, missing = (error_covariances(errors, np.where(third, none, camera), readings) for none in (0.0, np.nan))
    np.testing.assert_array_equal(zeros, missing)


@pytest.mark.parametrize(
    "stated", [np.full((PAIRS, 3, 3), np.nan), np.zeros((PAIRS, 3, 3)), np.tile(np.eye(3), (PAIRS, 1, 1))]
)
def test_missing_or_isotropic_covariances_tell_no_directions(stated: FloatArray) -> None:
    assert not is_anisotropic(np.broadcast_to(stated, (PAIRS, 3, 3)))


def test_errors_of_rounding_alone_have_covariances() -> None:
    _, _, camera, readings = drawn(np.random.default_rng(3), 8.0, 0.0)
    found = error_covariances(np.zeros((PAIRS, 3)), camera, readings)
    assert (np.linalg.eigvalsh(found) > 0.0).all()
