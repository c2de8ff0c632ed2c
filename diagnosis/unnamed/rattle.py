"""Find a marker with play on the hand: it lies on one side or the other of it, and nothing tells on which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.interfaces.records import FloatArray

# Distance of the two sides in standard deviations about each, and the worth of two sides over one [nats], from which a
# marker is called loose.
_APART, _NAMED = 3.0, 15.0
# A smaller play beside the noise across it is left to the noise.
_BEYOND_NOISE = 2.5
_ROUNDS = 50


@dataclass(frozen=True, eq=False)
class Rattle:
    """A loose marker.

    Attributes:
        half_m: half of its play [m].
        ratio: variance along the play over the variance across it, less one.
        axis: direction of the play in the marker's link (3,).
        ways: the same at each row (n, 3), in the measurement frame.
    """

    half_m: float
    ratio: float
    axis: FloatArray
    ways: FloatArray

    @property
    def what(self) -> str:
        """Short description."""
        return f"the marker is loose on the hand, by ±{1e3 * self.half_m:.2g} mm"

    def ways_of(self, fit: Fit) -> FloatArray:
        """Return the direction of the play at each row of a fit (n, 3), in the measurement frame."""
        return np.einsum("nji,j->ni", _turns(fit), self.axis)


def rattle(fit: Fit) -> Rattle | None:
    """Return the play of the marker that the residuals of a fit show; None where they do not lie on two sides."""
    rows, turns = fit.noise.weights > 0.0, _turns(fit)
    left = np.einsum("nij,nj->ni", turns, fit.observations.x - fit.predicted)
    variances, axes = np.linalg.eigh(np.cov(left[rows].T))
    across, along = float(variances[:2].mean()), float(variances[2])
    if along < _BEYOND_NOISE**2 * across:
        return None
    half, apart, worth = _two_sides(left[rows] @ axes[:, 2])
    if apart < _APART or worth < _NAMED:
        return None
    return Rattle(half, along / across - 1.0, axes[:, 2], np.einsum("nji,j->ni", turns, axes[:, 2]))


def _turns(fit: Fit) -> FloatArray:
    """Return the rotations (n, 3, 3) from the measurement frame to the marker's link."""
    run = fit.run
    return run.frames[:, -1, :3, :3].transpose(0, 2, 1) @ run.simulation.camera_pose[:3, :3]


def _two_sides(values: FloatArray) -> tuple[float, float, float]:
    """Fit two normal distributions of equal width to values (n,), by expectation maximisation.

    Returns:
        Half the distance of their means, the distance in standard deviations, and the worth over a single one [nats].
    """
    n = len(values)
    means, sigma, share = np.quantile(values, [0.2, 0.8]), float(values.std()) / 2.0, 0.5
    total = -np.inf
    for _ in range(_ROUNDS):
        logs = -0.5 * np.square((values[:, None] - means) / sigma) - np.log(sigma) + np.log([1.0 - share, share])
        both = np.logaddexp(logs[:, 0], logs[:, 1])
        own = np.exp(logs - both[:, None])
        total = float(both.sum())
        share = float(np.clip(own[:, 1].mean(), 0.01, 0.99))
        means = own.T @ values / np.maximum(own.sum(axis=0), 1e-9)
        sigma = float(np.sqrt((own * np.square(values[:, None] - means)).sum() / n))
    single = -n * (0.5 + float(np.log(values.std())))
    # The two sides cost a distance and a share, each known to about one part in the root of n.
    return 0.5 * float(abs(np.diff(means)[0])), float(abs(np.diff(means)[0])) / sigma, total - single - float(np.log(n))
