from __future__ import annotations

import numpy as np
import pytest

from kbmaps.prequential import shared_by


def series(rng: np.random.Generator, n: int, rho: float) -> np.ndarray:
    """Return a first-order autoregressive series of variance 1: neighbours correlate by rho."""
    values = rng.normal(size=(n, 3))
    for k in range(1, n):
        values[k] = rho * values[k - 1] + np.sqrt(1.0 - rho**2) * values[k]
    return values


@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6, 0.9])
def test_an_autoregressive_series_has_its_known_correlation_time(rho):
    estimates = [shared_by(series(np.random.default_rng(seed), 1000, rho)) for seed in range(20)]
    assert np.mean(estimates) == pytest.approx((1.0 + rho) / (1.0 - rho), rel=0.25)


def test_a_common_offset_is_shared_by_all():
    residuals = np.ones((400, 3)) + 0.1 * np.random.default_rng(0).normal(size=(400, 3))
    assert shared_by(residuals) > 100.0


@pytest.mark.parametrize("n", [0, 1, 7])
def test_too_short_a_series_shares_nothing(n):
    assert shared_by(np.ones((n, 3))) == 1.0


def test_no_residual_at_all_shares_nothing():
    assert shared_by(np.zeros((100, 3))) == 1.0
