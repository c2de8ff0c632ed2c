"""Find a marker that is loose on the hand: at each row it rests on an unknown side of its play."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import xlogy

from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.search.joint_selection import estimated_tolerances
from bodyschema.interfaces.records import FloatArray


class _Settings:
    """Settings of a loose marker.

    Sensitivity, each at 0.3 and 3 times over three recordings, one with a play of ± 2 mm beside 0.3 mm of noise: only
    `beyond_noise` at 3 times loses that play.
    """

    # Loose from here on: distance of the two sides in standard deviations about each, worth of two sides over one
    # [nats], and width along the play over the width across it.
    apart, named, beyond_noise = 3.0, 15.0, 2.5
    min_across = 1e-5  # of the width along it: with less, covariances cannot be inverted
    rounds = 50  # of expectation maximisation
    fits, same = 30, 1.0  # most fits beside a play, and the gain in likelihood that ends them [nats]
    # Cost of a play [nats]: it has no name, and three numbers, as a slip has. From 5 to 90, the verdicts on 17
    # recordings are the same.
    unnamed = 8.0 + 3.0 * 3.0
    fewest = 5  # a side with fewer rows may be of outliers


@dataclass(frozen=True, eq=False)
class LooseMarker:
    """A loose marker."""

    half_m: float  # half of its play [m]
    ratio: float  # variance along the play over the variance across it, less one
    axis: FloatArray  # direction of the play in the marker's link (3,)
    directions: FloatArray  # the same at each row (n, 3), in the measurement frame
    sides: FloatArray  # mean of the side, -1 or 1, on which the marker lies at each row (n,)
    # log-likelihood of the residuals with two sides, less the cost of the tolerances beside it, comparable with
    # `likelihood` of a fit [nats]
    likelihood: float
    is_clear: bool = True  # True if the sides are surely two, and farther apart than noise of any shape

    @property
    def what(self) -> str:
        return f"the marker is loose on the hand, by ±{1e3 * self.half_m:.2g} mm"

    def directions_at(self, fit: Fit) -> FloatArray:
        """Return the direction of the play at each row of a fit (n, 3), in the measurement frame."""
        return np.einsum("nji,j->ni", _marker_rotations(fit), self.axis)

    def removed_from(self, observations: Observations) -> Observations:
        """Return observations with the marker in the middle of its play, as far as its side at each row is known."""
        unsure = (1.0 - np.square(self.sides)) * self.ratio
        middle = observations.without_marker_play(self.half_m * self.sides[:, None] * self.directions)
        return middle.with_loose_marker(unsure, self.directions)


def rattle(fit: Fit) -> LooseMarker | None:
    """Return the play of the marker detected in the residuals of a fit; None if they do not lie on two sides."""
    play = _estimated_play(fit)
    return play if play is not None and play.is_clear else None


def rattle_with_refit(fit: Fit) -> LooseMarker | None:
    """Return the play of the marker, estimated together with the other parameters of a fit.

    The parameters may have followed the sides, and tolerances may hide them. So sides that are not clear yet are
    removed as well, and the fit and its tolerances follow the remainder. Initially the tolerances are limited to a
    workshop's: larger ones have probably followed the sides.
    """
    if fit.background.scales is not None and not fit.is_exact:
        fit = fit.with_tolerances(fit.background.scales.limited_to_workshop)
    play = _estimated_play(fit)
    for _ in range(_Settings.fits if play is not None else 0):
        assert play is not None
        fit = fit.to((_unabsorbed(play, fit) if play.is_clear else play).removed_from(fit.observations))
        if not fit.is_exact:
            fit = fit.with_tolerances(estimated_tolerances(fit).scales)
        again = _estimated_play(fit)
        if again is None or again.likelihood < play.likelihood + _Settings.same:
            break
        play = again
    return play if play is not None and play.is_clear else None


def _estimated_play(fit: Fit) -> LooseMarker | None:
    """Return the most probable play, however small; None if the residuals are too few or have no noise."""
    rows = fit.noise.weights > 0.0
    if fit.is_exact or rows.sum() < 2 * _Settings.fewest:
        # With the play removed, positions of a simulation have no noise to compare it with.
        return None
    left = _residuals_on_link(fit)
    variances, axes = np.linalg.eigh(np.cov(left[rows].T))
    along = left @ axes[:, 2]
    directions = np.einsum("nji,j->ni", _marker_rotations(fit), axes[:, 2])
    means, sigma, net_evidence, sides = _fit_two_sides(along, rows)
    # Rows that are measured less accurately than others look like a second side.
    stated = np.sqrt(np.einsum("ni,nij,nj->n", directions, fit.observations.noise_covariances, directions))
    net_evidence = min(net_evidence, _fit_two_sides(along / stated, rows)[2])
    alike = _same_side_evidence(sides, rows, fit.observations.motion.begins)
    if alike > 0.0:
        sides = np.where(_changing_side(sides), 0.0, sides)
    net_evidence += alike
    half = 0.5 * float(means[1] - means[0])
    ratio = float(variances[2] / max(variances[:2].mean(), _Settings.min_across**2 * variances[2])) - 1.0
    rarer = min(int((sides[rows] < 0.0).sum()), int((sides[rows] > 0.0).sum()))
    is_clear = (
        2.0 * half >= _Settings.apart * sigma
        and net_evidence >= _Settings.named
        and ratio >= _Settings.beyond_noise**2 - 1.0
    )
    # A marker that changed its place once has slipped.
    sure = np.sign(sides[rows & (sides != 0.0)])
    is_clear = is_clear and int((np.diff(sure) != 0.0).sum()) > 1
    whole = _likelihood(fit, rows) + net_evidence - _Settings.unnamed
    return LooseMarker(half, ratio, axes[:, 2], directions, sides, whole, is_clear and rarer >= _Settings.fewest)


def _unabsorbed(play: LooseMarker, fit: Fit) -> LooseMarker:
    """Return the play with these sides, at the size that it has if the fit and its tolerances absorb no part of it."""
    n, observations = len(play.sides), fit.observations
    by_link = np.swapaxes(_marker_rotations(fit), 1, 2) * play.sides[:, None, None]
    taken_out = np.broadcast_to(observations.play, observations.x.shape)[:, :, None]
    moved = fit.fully_whitened(fit.weighted(np.concatenate([by_link, taken_out], axis=2)).reshape(3 * n, 4))
    basis = fit.effect_basis.reshape(3 * n, -1)
    columns = moved[:, :3] - basis @ (basis.T @ moved[:, :3])
    to_side = np.linalg.lstsq(columns, fit.whitened_residuals.ravel() + moved[:, 3], rcond=None)[0]
    half = float(np.linalg.norm(to_side))
    if half == 0.0:
        return play
    return replace(
        play,
        half_m=half,
        axis=to_side / half,
        directions=np.einsum("nji,j->ni", _marker_rotations(fit), to_side / half),
    )


def _same_side_evidence(sides: FloatArray, rows: NDArray[np.bool_], begins: NDArray[np.bool_]) -> float:
    """Return the evidence that neighbouring rows lie on the same side: their mutual information [nats]."""
    follows = (rows & ~begins)[1:] & rows[:-1]
    upper = 0.5 * (1.0 + sides)
    before, after = (np.stack([1.0 - own, own]) for own in (upper[:-1][follows], upper[1:][follows]))
    both = before @ after.T + 1e-9
    apart = np.outer(both.sum(axis=1), both.sum(axis=0)) / both.sum()
    # One additional number: the rate at which the side changes.
    return max(float((both * np.log(both / apart)).sum() - 0.5 * np.log(max(both.sum(), 1.0))), 0.0)


def _changing_side(sides: FloatArray) -> NDArray[np.bool_]:
    """Return the rows (n,) beside a change of the side, at which the marker may lie between the two."""
    changes = sides[1:] * sides[:-1] < 0.0
    return np.append(changes, False) | np.append(False, changes)


def likelihood(fit: Fit) -> float:
    """Return the log-likelihood of a fit's residuals as outliers, and normal noise of any shape on the marker's link.

    The prior cost of causes and tolerances is subtracted [nats].
    """
    return max(_likelihood(fit, fit.noise.weights > least) for least in (0.0, 0.5))


def _likelihood(fit: Fit, rows: NDArray[np.bool_]) -> float:
    """Return the same [nats] if some rows (n,) are the marker, and the other trusted ones outliers."""
    observations, scales = fit.observations, fit.background.scales
    total, count = int(observations.trusted.sum()), int(rows.sum())
    off = max(total - count, 0)
    spread = observations.outlier_density[0] + np.linalg.slogdet(observations.whitening[0])[1]
    noise = (
        -0.5
        * count
        * (float(np.linalg.slogdet(np.cov(_residuals_on_link(fit)[rows].T))[1]) + 3.0 * np.log(2.0 * np.pi * np.e))
    )
    outliers = off * float(spread) + float(xlogy(off, off / total) + xlogy(count, count / total))
    return noise + outliers - fit.prior_cost - (0.0 if scales is None else scales.prior_penalty)


def _residuals_on_link(fit: Fit) -> FloatArray:
    """Return the residuals (n, 3) [m] in the marker's link, its play included."""
    return np.einsum("nij,nj->ni", _marker_rotations(fit), fit.observations.x + fit.observations.play - fit.predicted)


def _marker_rotations(fit: Fit) -> FloatArray:
    """Return the rotations (n, 3, 3) from the measurement frame to the marker's link."""
    run = fit.run
    return run.frames[:, -1, :3, :3].transpose(0, 2, 1) @ run.simulation.camera_pose[:3, :3]


def _fit_two_sides(values: FloatArray, rows: NDArray[np.bool_]) -> tuple[FloatArray, float, float, FloatArray]:
    """Fit two normal distributions of equal width to those of values (n,) that count, by expectation maximisation.

    Returns:
        Their means (2,), their width, the worth over a single one [nats], and the mean side of each value (n,).
    """
    counted, n = values[rows], int(rows.sum())
    means, sigma, share = _initial_split(counted)
    total = -np.inf
    for _ in range(_Settings.rounds):
        both, own = _shared(counted, means, sigma, share)
        total = float(both.sum())
        share = float(np.clip(own[:, 1].mean(), 0.01, 0.99))
        means = own.T @ counted / np.maximum(own.sum(axis=0), 1e-9)
        sigma = float(np.sqrt((own * np.square(counted[:, None] - means)).sum() / n))
    single = -n * (0.5 + float(np.log(counted.std())))
    sides = _shared(values, means, sigma, share)[1] @ [-1.0, 1.0]
    # The two sides cost a distance and a share, each known to about one part in the root of n.
    return means, sigma, total - single - float(np.log(n)), sides


def _initial_split(values: FloatArray) -> tuple[FloatArray, float, float]:
    """Return the means (2,) of the lower and the upper values (n,), cut where this is most probable; width, and share.

    One side may have few rows, so possibly none of the usual quantiles lies on it.
    """
    ordered = np.sort(values - values.mean())
    n, below = len(ordered), np.arange(_Settings.fewest, len(ordered) - _Settings.fewest + 1)
    sums = np.cumsum(ordered)[below - 1]
    share = below / n
    within = np.maximum(float(ordered @ ordered) / n - np.square(sums) / (n * n * share * (1.0 - share)), 1e-300)
    cost = 0.5 * np.log(within) - share * np.log(share) - (1.0 - share) * np.log1p(-share)
    cut = int(np.argmin(cost))
    means = values.mean() + sums[cut] * np.array([1.0 / below[cut], -1.0 / (n - below[cut])])
    return means, float(np.sqrt(within[cut])), 1.0 - float(share[cut])


def _shared(values: FloatArray, means: FloatArray, sigma: float, share: float) -> tuple[FloatArray, FloatArray]:
    """Return log-likelihoods (n,), and the probabilities of the two sides (n, 2)."""
    logs = -0.5 * np.square((values[:, None] - means) / sigma) - np.log(sigma) + np.log([1.0 - share, share])
    both = np.logaddexp(logs[:, 0], logs[:, 1])
    return both, np.exp(logs - both[:, None])
