from __future__ import annotations

import numpy as np
import pytest

from bodyschema.learning.uncertainty import model_discrepancy

NONE = np.zeros(3)


def bent(n: int) -> np.ndarray:
    """Return a model discrepancy of 3 mm RMS on each axis that changes slowly along a path."""
    phase = np.linspace(0.0, 12.0 * np.pi, n)
    return 0.003 * np.sqrt(2.0) * np.stack([np.sin(phase), np.cos(phase), np.sin(phase + 1.0)], axis=1)


@pytest.mark.parametrize("claimed", [1e-12, 1e-4])
def test_path_misfit_is_found_for_any_claimed_noise(claimed: float) -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.002, (500, 3))
    found = model_discrepancy(bent(500) + noise, np.full(3, claimed), NONE, neighbours=True)
    np.testing.assert_allclose(found, 0.003, rtol=0.1)


@pytest.mark.parametrize("neighbours", [True, False])
def test_noise_alone_is_mostly_no_misfit(neighbours: bool) -> None:
    found = [
        model_discrepancy(
            np.random.default_rng(seed).normal(0.0, 0.002, (500, 3)), np.full(3, 0.002**2), NONE, neighbours=neighbours
        )
        for seed in range(50)
    ]
    assert (np.array(found) > 0.0).mean() < 0.1


def test_misfit_of_distant_poses_excludes_claimed_noise() -> None:
    rng = np.random.default_rng(0)
    errors = rng.normal(0.0, np.hypot(0.003, 0.002), (500, 3))
    np.testing.assert_allclose(model_discrepancy(errors, np.full(3, 0.002**2), NONE, neighbours=False), 0.003, rtol=0.1)


def test_previous_tool_misfit_counts_while_pairs_are_few() -> None:
    before = np.full(3, 0.004)
    few = model_discrepancy(np.zeros((2, 3)), np.full(3, 1e-6), before, neighbours=True)
    many = model_discrepancy(np.zeros((50, 3)), np.full(3, 1e-6), before, neighbours=True)
    np.testing.assert_allclose([few, many], [np.sqrt(0.8) * before, NONE])


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 5))])
def test_misfit_is_corrected_for_fitted_parameters(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, numbers = 100, 50
    basis, _ = np.linalg.qr(rng.normal(size=(rows, numbers)))
    missed = rng.normal(0.0, 0.003, (rows, 3))
    errors = missed - basis @ (basis.T @ missed)
    scatter = float(np.sqrt(np.square(errors).sum() / (3 * (rows - numbers))))
    found = model_discrepancy(errors, np.full(3, 1e-8), NONE, neighbours=False, scatter=scatter)
    np.testing.assert_allclose(np.sqrt(np.square(found).mean()), 0.003, rtol=0.2)


@pytest.mark.parametrize("neighbours", [True, False])
def test_outlier_rejected_by_fit_is_no_misfit(neighbours: bool) -> None:
    errors = np.random.default_rng(0).normal(0.0, 0.002, (100, 3))
    errors[50] = 0.05
    found = model_discrepancy(errors, np.full(3, 0.002**2), NONE, neighbours=neighbours, scatter=0.002)
    np.testing.assert_array_equal(found, NONE)


def test_widely_contradicted_fit_counts_all_pairs_as_misfit() -> None:
    errors = np.random.default_rng(0).normal(0.0, 0.003, (100, 3))
    found = model_discrepancy(errors, np.full(3, 1e-8), NONE, neighbours=False, scatter=1e-5)
    np.testing.assert_allclose(found, 0.003, rtol=0.2)
