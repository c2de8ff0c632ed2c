"""Find a marker with play on the hand: it lies on one side or the other of it, and nothing tells on which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.interfaces.records import FloatArray

# Distance of the two sides in standard deviations about each, and the worth of two sides over one [nats], from which a
# marker is called loose.
_APART, _NAMED = 3.0, 15.0
# A smaller play beside the noise across it is left to the noise.
_BEYOND_NOISE = 2.5
# Least width across the play, as a share of that along it: with less, covariances cannot be inverted.
_LEAST_ACROSS = 1e-5
_ROUNDS = 50
# Most fits beside a play, and the gain in likelihood that ends them [nats].
_FITS, _SAME = 8, 1.0


@dataclass(frozen=True, eq=False)
class Rattle:
    """A loose marker.

    Attributes:
        half_m: half of its play [m].
        ratio: variance along the play over the variance across it, less one.
        axis: direction of the play in the marker's link (3,).
        ways: the same at each row (n, 3), in the measurement frame.
        sides: mean of the side, -1 or 1, on which the marker lies at each row (n,).
        likelihood: log-likelihood of the residuals with two sides; comparable with `likelihood` of a fit [nats].
    """

    half_m: float
    ratio: float
    axis: FloatArray
    ways: FloatArray
    sides: FloatArray
    likelihood: float

    @property
    def is_small(self) -> bool:
        """True for a play that is left to the noise."""
        return self.ratio < _BEYOND_NOISE**2 - 1.0

    @property
    def what(self) -> str:
        """Short description."""
        return f"the marker is loose on the hand, by ±{1e3 * self.half_m:.2g} mm"

    def ways_of(self, fit: Fit) -> FloatArray:
        """Return the direction of the play at each row of a fit (n, 3), in the measurement frame."""
        return np.einsum("nji,j->ni", _turns(fit), self.axis)

    def taken_out_of(self, observations: Observations) -> Observations:
        """Return observations with the marker in the middle of its play, as far as its side at each row is known."""
        unsure = (1.0 - np.square(self.sides)) * self.ratio
        middle = observations.without_play(self.half_m * self.sides[:, None] * self.ways)
        return middle.with_rattle(unsure, self.ways)


def rattle(fit: Fit) -> Rattle | None:
    """Return the play of the marker that the residuals of a fit show; None where they do not lie on two sides."""
    play = _two_sided(fit)
    return None if play is None or play.is_small else play


def rattle_beside(fit: Fit) -> Rattle | None:
    """Return the play of the marker beside a fit that goes with it; its numbers may have followed the sides."""
    play, likelier = None, _two_sided(fit)
    for _ in range(_FITS):
        if likelier is None or (play is not None and likelier.likelihood < play.likelihood + _SAME):
            break
        play = likelier
        fit = fit.to(play.taken_out_of(fit.observations))
        likelier = _two_sided(fit)
    return None if play is None or play.is_small else play


def _two_sided(fit: Fit) -> Rattle | None:
    if fit.is_exact:
        # With the play taken out of them, positions of a simulation have no noise to compare it with.
        return None
    rows, left = fit.noise.weights > 0.0, _on_link(fit)
    variances, axes = np.linalg.eigh(np.cov(left[rows].T))
    means, sigma, worth, sides = _two_sides(left @ axes[:, 2], rows)
    half = 0.5 * float(means[1] - means[0])
    if 2.0 * half < _APART * sigma or worth < _NAMED:
        return None
    ratio = float(variances[2] / max(variances[:2].mean(), _LEAST_ACROSS**2 * variances[2])) - 1.0
    ways = np.einsum("nji,j->ni", _turns(fit), axes[:, 2])
    return Rattle(half, ratio, axes[:, 2], ways, sides, likelihood(fit) + worth)


def likelihood(fit: Fit) -> float:
    """Return the log-likelihood of a fit's residuals as normal noise of any shape on the marker's link [nats]."""
    rows = fit.noise.weights > 0.0
    return -0.5 * int(rows.sum()) * float(np.linalg.slogdet(np.cov(_on_link(fit)[rows].T))[1])


def _on_link(fit: Fit) -> FloatArray:
    """Return the residuals (n, 3) [m] in the marker's link, its play included."""
    return np.einsum("nij,nj->ni", _turns(fit), fit.observations.x + fit.observations.play - fit.predicted)


def _turns(fit: Fit) -> FloatArray:
    """Return the rotations (n, 3, 3) from the measurement frame to the marker's link."""
    run = fit.run
    return run.frames[:, -1, :3, :3].transpose(0, 2, 1) @ run.simulation.camera_pose[:3, :3]


def _two_sides(values: FloatArray, rows: NDArray[np.bool_]) -> tuple[FloatArray, float, float, FloatArray]:
    """Fit two normal distributions of equal width to those of values (n,) that count, by expectation maximisation.

    Returns:
        Their means (2,), their width, the worth over a single one [nats], and the mean side of each value (n,).
    """
    counted, n = values[rows], int(rows.sum())
    means, sigma, share = np.quantile(counted, [0.2, 0.8]), float(counted.std()) / 2.0, 0.5
    total = -np.inf
    for _ in range(_ROUNDS):
        both, own = _shared(counted, means, sigma, share)
        total = float(both.sum())
        share = float(np.clip(own[:, 1].mean(), 0.01, 0.99))
        means = own.T @ counted / np.maximum(own.sum(axis=0), 1e-9)
        sigma = float(np.sqrt((own * np.square(counted[:, None] - means)).sum() / n))
    single = -n * (0.5 + float(np.log(counted.std())))
    sides = _shared(values, means, sigma, share)[1] @ [-1.0, 1.0]
    # The two sides cost a distance and a share, each known to about one part in the root of n.
    return means, sigma, total - single - float(np.log(n)), sides


def _shared(values: FloatArray, means: FloatArray, sigma: float, share: float) -> tuple[FloatArray, FloatArray]:
    """Return log-likelihoods (n,), and the probabilities of the two sides (n, 2)."""
    logs = -0.5 * np.square((values[:, None] - means) / sigma) - np.log(sigma) + np.log([1.0 - share, share])
    both = np.logaddexp(logs[:, 0], logs[:, 1])
    return both, np.exp(logs - both[:, None])
