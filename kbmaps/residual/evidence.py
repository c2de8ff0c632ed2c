"""Linear Gaussian models with grouped weights: evidence, and selection of groups by it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.lapack import lower_inverse
from kbmaps.robust import RobustSettings


class GroupSettings:
    """Settings of the choice of groups.

    Sensitivity: each at 0.3 and 3 times changes error and sigma of a bent arm's models at 150 pairs by less than 1 %,
    but for `least_gain` by 5 %, `window` by 1 %; not varied: `rounds`.
    """

    window: float = 4.0  # models less probable than the best by more than this many nats are left out of averages
    min_gain: float = 0.5  # A group that gains less is left out of averages: it makes almost no difference
    # Sets of groups less probable than the chosen one by more than this many nats are not extended.
    swap_window: float = 8.0
    rounds: int = 40
    settled: float = 0.02
    # Candidate variances of a group, relative to the variance at which its best determined direction is barely visible.
    tried_variances = 10.0 ** np.arange(0.0, 7.0, 0.5)
    # Prior odds against a group [nats]. Its variance is optimised, which inflates the likelihood.
    price_nats: float = 2.0


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over N whitened rows (a, t) of a linear model t = a·w + noise."""

    gram: FloatArray  # Σ a aᵀ (P, P)
    product: FloatArray  # Σ a t (P,)
    square: float  # Σ t²
    count: int  # N

    @classmethod
    def of(cls, design: FloatArray, target: FloatArray) -> Moments:
        """Return the moments of rows (N, P) and targets (N,)."""
        return cls(design.T @ design, design.T @ target, float(target @ target), len(target))

    @classmethod
    def total(cls, parts: Sequence[Moments]) -> Moments:
        """Return the moments of the rows of all parts, at least one, over the same columns."""
        gram, product = parts[0].gram.copy(), parts[0].product.copy()
        for part in parts[1:]:
            gram += part.gram
            product += part.product
        return cls(gram, product, sum(part.square for part in parts), sum(part.count for part in parts))

    def minus(self, other: Moments) -> Moments:
        """Return the moments without the rows of `other`."""
        return Moments(
            self.gram - other.gram, self.product - other.product, self.square - other.square, self.count - other.count
        )


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of the active columns' weights.

    Attributes:
        mean: (A,).
        spread: W (A, A) with the covariance W Wᵀ.
        square: whitened squared residuals.
        log_evidence: log marginal likelihood up to a constant of the rows.
        used: number of weights that the data determine, by group.
    """

    mean: FloatArray
    spread: FloatArray
    square: float
    log_evidence: float
    used: dict[str, float]


@dataclass(frozen=True, eq=False)
class Average:
    """Weights averaged over several models by their probability."""

    groups: tuple[str, ...]  # of any of the models, besides the one that all have
    mean: FloatArray  # (A,) over the columns of "" and then of the groups
    spread: FloatArray  # W (A, A) with the covariance W Wᵀ


class GroupedModel:
    """Weights N(centre, variance of their group), rows with noise of one variance.

    The group of the name "" is always active; its variance is 1 and its prior mean `centre`. The others' prior means
    are 0 and their variances are estimated: groups that the evidence (MacKay 1992) does not support are left out.

    Args:
        moments: moments over the columns of all groups.
        columns: the columns of each group.
        centre: prior mean of the weights of the group "".
        least_noise: lower bound of the noise [rows' unit].
        noise: its initial value.
        noise_before: noise [rows' unit] from earlier data, and the number of rows that it counts for.
        blocks: moments of runs of neighbouring rows, if a group must also improve the prediction of each run from the
            others.
    """

    def __init__(
        self,
        moments: Moments,
        columns: Mapping[str, slice],
        centre: FloatArray,
        *,
        least_noise: float,
        noise: float,
        noise_before: tuple[float, float] = (0.0, 0.0),
        blocks: Sequence[Moments] = (),
    ) -> None:
        self._moments, self._columns = moments, columns
        self._blocks = blocks
        self._centre = centre
        self._least_noise, self._noise_before = least_noise, noise_before
        self.noise = noise
        self.variances: dict[str, float] = {}

    def posterior(self, moments: Moments | None = None, active: Mapping[str, float] | None = None) -> Posterior:
        """Return the posterior of the active groups, or of other moments or groups if given."""
        active = self.variances if active is None else active
        moments = self._moments if moments is None else moments
        index = self.index(active)
        parts: list[FloatArray] = [np.ones(len(self._centre))]
        for name, value in active.items():
            parts.append(value * np.ones(self._columns[name].stop - self._columns[name].start))
        variance = np.concatenate(parts)
        precision = 1.0 / self.noise**2
        centre = np.zeros(len(index))
        centre[: len(self._centre)] = self._centre
        hessian = moments.gram[np.ix_(index, index)] * precision
        slope = moments.product[index] * precision + centre / variance
        root = np.sqrt(variance)
        scaled = hessian * root[:, None] * root + np.eye(len(index))
        lower = _cholesky(scaled)
        spread = root[:, None] * lower_inverse(lower).T
        mean = spread @ (spread.T @ slope)
        product = moments.product[index]
        square = moments.square - 2.0 * float(mean @ product) + float(mean @ (hessian @ mean)) / precision
        square = max(square, 0.0)
        offset = mean - centre
        evidence = -0.5 * (square * precision + float(offset @ (offset / variance)))
        evidence -= float(np.log(np.diag(lower)).sum()) + moments.count * math.log(self.noise)
        shrunk = np.square(spread).sum(axis=1) / variance
        return Posterior(mean, spread, square, evidence, self._used(active, 1.0 - shrunk))

    def square_of(self, weights: FloatArray) -> float:
        """Return Σ (a·w)² over the rows, for weights of the active columns."""
        index = self.index()
        return float(weights @ (self._moments.gram[np.ix_(index, index)] @ weights))

    def index(self, groups: Iterable[str] | None = None) -> IntArray:
        """Return the columns of the active groups, in the order of the posterior's weights."""
        spans = [self._columns[name] for name in ("", *(self.variances if groups is None else groups))]
        return np.array([column for span in spans for column in range(span.start, span.stop)], dtype=np.intp)

    def select(self, candidates: tuple[str, ...]) -> None:
        """Add groups while the evidence gains by more than their price, then drop those that are not needed."""
        self.settle()
        rejected: set[str] = set()
        while True:
            posterior = self.posterior()
            gains = {
                g: self._gain(g, self.variances, posterior)
                for g in candidates
                if g not in self.variances and g not in rejected
            }
            best = max(gains, key=lambda g: gains[g][0], default=None)
            if best is None or gains[best][0] < GroupSettings.price_nats:
                break
            self._try(best, gains[best][1])
            rejected.add(best)
        self.prune()

    def prune(self) -> None:
        """Drop groups that the evidence does not need, the least needed first."""
        while self._drop_least_needed():
            self.settle()

    def average(self, candidates: Sequence[str]) -> Average:
        """Return the average over the active groups and all sets that differ by one group removed, added, or exchanged.

        Weighted by evidence and prior odds of e^−price per group. Hoeting et al., "Bayesian model averaging",
        Statistical Science 14, 1999; improbable models are left out (Occam's window there).
        """
        whole = self.posterior()
        models, log_odds = [(dict(self.variances), whole)], [0.0]
        bases = [(dict(self.variances), whole, 0.0)]
        for name in self.variances:
            rest = {group: value for group, value in self.variances.items() if group != name}
            posterior = self.posterior(active=rest)
            models.append((rest, posterior))
            log_odds.append(posterior.log_evidence - whole.log_evidence + GroupSettings.price_nats)
            bases.append((rest, posterior, log_odds[-1]))
        for active, posterior, odds in bases:
            for name in candidates if odds > -GroupSettings.swap_window else ():
                gain, variance = (0.0, 0.0) if name in self.variances else self._gain(name, active, posterior)
                if gain > GroupSettings.min_gain and odds + gain - GroupSettings.price_nats > -GroupSettings.window:
                    more = {**active, name: variance}
                    models.append((more, self.posterior(active=more)))
                    log_odds.append(odds + gain - GroupSettings.price_nats)
        best = max(log_odds)
        kept = [k for k, odds in enumerate(log_odds) if odds > best - GroupSettings.window]
        shares = np.exp(np.array([log_odds[k] for k in kept]) - best)
        return self._mixture([models[k] for k in kept], shares / shares.sum())

    def _mixture(self, models: Sequence[tuple[dict[str, float], Posterior]], shares: FloatArray) -> Average:
        groups = tuple(dict.fromkeys(name for active, _ in models for name in active))
        place = {int(column): k for k, column in enumerate(self.index(groups))}
        means, spreads = np.zeros((len(models), len(place))), np.zeros((len(models), len(place), len(place)))
        for k, (active, posterior) in enumerate(models):
            at = [place[int(column)] for column in self.index(active)]
            means[k, at] = posterior.mean
            spreads[k, at, : len(at)] = posterior.spread
        mean = shares @ means
        roots = np.sqrt(shares)
        rows = (roots[:, None, None] * spreads.swapaxes(1, 2)).reshape(-1, len(place))
        rows = np.concatenate([rows, roots[:, None] * (means - mean)])
        return Average(groups, mean, cast(FloatArray, np.linalg.qr(rows, mode="r")).T)

    def settle(self, rounds: int = GroupSettings.rounds) -> None:
        """Set the noise and the groups' variances that make the data most probable, by MacKay's fixed point."""
        for _ in range(rounds):
            posterior = self.posterior()
            used = sum(posterior.used.values())
            noise = max(math.sqrt(self._noise_variance(posterior.square, used)), self._least_noise)
            change = abs(math.log(noise / self.noise))
            self.noise = noise
            start = len(self._centre)
            for name, old in self.variances.items():
                width = self._columns[name].stop - self._columns[name].start
                weights = posterior.mean[start : start + width]
                start += width
                new = max(float(weights @ weights) / max(posterior.used[name], 1e-9), RobustSettings.variance_floor)
                change = max(change, 0.5 * abs(math.log(new / old)))
                self.variances[name] = new
            if change < GroupSettings.settled:
                return

    def _noise_variance(self, square: float, used: float) -> float:
        before, rows = self._noise_before
        return (square + rows * before**2) / max(self._moments.count - used + rows, 1.0)

    def _try(self, group: str, variance: float) -> None:
        """Add a group unless held-out blocks contradict it."""
        before, errors = (dict(self.variances), self.noise), self._left_out_errors()
        self.variances[group] = variance
        self.settle()
        if self._blocks:
            gains = errors - self._left_out_errors()
            if gains.mean() <= gains.std(ddof=1) / math.sqrt(len(gains)):
                self.variances, self.noise = before

    def _left_out_errors(self) -> FloatArray:
        """Return the squared error of each block, predicted from all others."""
        index = self.index()
        errors: list[float] = []
        for block in self._blocks:
            mean = self.posterior(self._moments.minus(block)).mean
            errors.append(block.square + float(mean @ (block.gram[np.ix_(index, index)] @ mean)))
            errors[-1] -= 2.0 * float(mean @ block.product[index])
        return np.array(errors)

    def _drop_least_needed(self) -> bool:
        if not self.variances:
            return False
        whole = self.posterior().log_evidence
        losses: dict[str, float] = {}
        for name in self.variances:
            rest = {group: value for group, value in self.variances.items() if group != name}
            losses[name] = whole - self.posterior(active=rest).log_evidence
        least = min(losses, key=lambda name: losses[name])
        if losses[least] >= GroupSettings.price_nats:
            return False
        del self.variances[least]
        return True

    def _gain(self, group: str, active: Mapping[str, float], posterior: Posterior) -> tuple[float, float]:
        """Return the evidence that a group adds at its best variance, with everything else fixed, and that variance.

        With the part of the group's rows that the active columns do not explain, S = U Λ Uᵀ and z, the gain is
        ½ Σ (v y² / (1 + v λ) − ln (1 + v λ)), y = Uᵀ z.
        """
        index = self.index(active)
        columns = self._columns[group]
        precision = 1.0 / self.noise**2
        cross = self._moments.gram[index, columns] * precision
        reduced = posterior.spread.T @ cross
        schur = self._moments.gram[columns, columns] * precision - reduced.T @ reduced
        slope = self._moments.product[columns] * precision - cross.T @ posterior.mean
        values, directions = np.linalg.eigh(schur)
        values = np.maximum(values, 0.0)
        if values[-1] <= 0.0:
            return -math.inf, 1.0
        squares = np.square(directions.T @ slope)
        tried = (GroupSettings.tried_variances / values[-1])[:, None]
        gains = 0.5 * (tried * squares / (1.0 + tried * values) - np.log1p(tried * values)).sum(axis=1)
        best = int(gains.argmax())
        return float(gains[best]), float(tried[best, 0])

    def _used(self, active: Mapping[str, float], determined: FloatArray) -> dict[str, float]:
        used: dict[str, float] = {}
        start = 0
        for name in ("", *active):
            width = self._columns[name].stop - self._columns[name].start
            used[name] = float(determined[start : start + width].sum())
            start += width
        return used


def _cholesky(matrix: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor; if rounding made the matrix indefinite, that of a nearby one (tighter prior).

    Raises:
        LinAlgError: it is indefinite by more than rounding.
    """
    rounding = len(matrix) * np.finfo(np.float64).eps * float(np.diag(matrix).max())
    for share in (0.0, 10.0, 1e3):
        with contextlib.suppress(np.linalg.LinAlgError):
            return cast(FloatArray, np.linalg.cholesky(matrix + share * rounding * np.eye(len(matrix))))
    return cast(FloatArray, np.linalg.cholesky(matrix + 1e5 * rounding * np.eye(len(matrix))))
