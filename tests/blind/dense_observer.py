"""Evidence for the hidden causes, computed by a linear Gaussian observer of the true generator.

It knows the scale of the tolerances, the noise and the signature of each cause; it does not know the tolerances
themselves, the amounts, or which causes there are. Its evidence is averaged over the noise, with the true tolerances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .arrays import BoolArray, FloatArray, IntArray

NEAR = 8  # rivals that are tried beside another one
SAME_SHARE = 1e-3  # part of a cause's signal that is left by a rival that can be all that it is


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence for one cause.

    Attributes:
        nats: by how much the true set is more probable than the best one without this cause.
        rival: indices of the causes in that set.
    """

    nats: float
    rival: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Observer:
    """Information about all causes, tolerances and placement marginalised.

    Attributes:
        spans: columns of each cause.
        G: information (p, p) about all amounts, in units of their usual sizes, beside tolerances and noise.
        Q: covariance (p, p) of the noise in the same.
        told: contribution of the true tolerances to the causes' data (p,).
        free: information (p, p) with tolerances of zero, with the unknown parameters of camera and marker.
        amounts: of every cause as if it were there, in usual sizes, shape (p,).
        costs: cost of each cause (K,) [nats].
    """

    spans: tuple[slice, ...]
    G: FloatArray
    Q: FloatArray
    told: FloatArray
    free: FloatArray
    amounts: FloatArray
    costs: FloatArray

    @classmethod
    def of(
        cls,
        flat: FloatArray,
        background: FloatArray,
        drawn: FloatArray,
        causes: Sequence[FloatArray],
        amounts: Sequence[FloatArray],
        costs: FloatArray,
    ) -> Observer:
        """Return an observer of whitened columns, rows of noise 1.

        Args:
            flat: columns of entirely unknown parameters (r, f).
            background: columns of tolerances, each times its 1 sigma (r, b).
            drawn: the true tolerances, in sigmas (b,).
            causes: columns of each cause times their usual sizes, (r, m) each.
            amounts: of each cause in usual sizes (m,).
            costs: of each cause [nats].
        """
        ends = np.cumsum([0, *(block.shape[1] for block in causes)])
        spans = tuple(slice(int(a), int(b)) for a, b in pairwise(ends))
        U = np.column_stack(causes)
        if flat.shape[1]:
            basis = np.linalg.qr(flat / np.linalg.norm(flat, axis=0))[0]
            U, background = U - basis @ (basis.T @ U), background - basis @ (basis.T @ background)
        M = np.linalg.inv(np.eye(background.shape[1]) + background.T @ background)
        across = U.T @ background
        free = U.T @ U
        return cls(
            spans=spans,
            G=free - across @ M @ across.T,
            Q=free - across @ M @ across.T - across @ M @ M @ across.T,
            told=across @ (M @ drawn),
            free=free,
            amounts=np.concatenate(list(amounts)),
            costs=costs,
        )

    def evidence(self, truth: Sequence[int]) -> tuple[tuple[Evidence, ...], float]:
        """Return the evidence for each true cause, and the margin over the best set with one more cause."""
        data = self._data(truth)
        whole = self._log_evidence(truth, data)
        spare = -float(self._gains(truth, data).max())
        return tuple(self._one(cause, truth, whole, data) for cause in truth), spare

    def same(self, cause: int, truth: Sequence[int]) -> list[int]:
        """Return equivalent causes with as few numbers: any motion of them explains the true cause's signal."""
        beside = [k for k in truth if k != cause]
        signal = self.amounts[self.spans[cause]]
        whole = self._left(cause, signal, beside)
        return [
            k
            for k in range(len(self.spans))
            if k not in truth
            and self._count(k) <= self._count(cause)
            and self._left(cause, signal, [*beside, k]) <= SAME_SHARE * whole
        ]

    def _one(self, cause: int, truth: Sequence[int], whole: float, data: FloatArray) -> Evidence:
        """Find the best set without a true cause: fewer causes, one or two others, one in place of two."""
        without = [k for k in truth if k != cause]
        barred = [cause, *self.same(cause, truth)]
        alone = self._gains(without, data, barred)
        bases = [without, *([*without, int(k)] for k in np.argsort(-alone)[:NEAR] if np.isfinite(alone[k]))]
        bases += [[k for k in without if k != dropped] for dropped in without]
        best, rival = -math.inf, ()
        for base in bases:
            gains, value = self._gains(base, data, barred), self._log_evidence(base, data)
            added = int(np.argmax(gains))
            for better, found in ((value, base), (value + float(gains[added]), [*base, added])):
                if better > best:
                    best, rival = better, tuple(k for k in found if k not in truth)
        return Evidence(whole - best, rival)

    def _gains(self, base: Sequence[int], data: FloatArray, barred: Sequence[int] = ()) -> FloatArray:
        """Return the gain in log evidence of a set by each cause (K,), -inf for those in it and for `barred`."""
        chosen = self._columns(base)
        p = len(self.amounts)
        size = max(self._count(k) for k in range(len(self.spans)))
        places = np.full((len(self.spans), size), p)  # p is a column of nothing
        for k, span in enumerate(self.spans):
            places[k, : self._count(k)] = np.arange(span.start, span.stop)
        inner = np.eye(len(chosen)) + self.G[np.ix_(chosen, chosen)]
        X = np.linalg.solve(inner, self.G[chosen]) if len(chosen) else np.empty((0, p))
        S, noise, h = np.zeros((p + 1, p + 1)), np.zeros((p + 1, p + 1)), np.zeros(p + 1)
        mixed = X.T @ self.Q[chosen]
        S[:p, :p] = self.G - self.G[:, chosen] @ X
        noise[:p, :p] = self.Q - mixed - mixed.T + X.T @ self.Q[np.ix_(chosen, chosen)] @ X
        h[:p] = data - X.T @ data[chosen]
        at = places[:, :, None], places[:, None, :]
        blocks, wanted = np.eye(size) + S[at], noise[at] + h[places][:, :, None] * h[places][:, None, :]
        fits = np.trace(np.linalg.solve(blocks, wanted), axis1=1, axis2=2)
        gains = 0.5 * (fits - np.linalg.slogdet(blocks)[1]) - self.costs
        gains[[*base, *barred]] = -np.inf
        return gains

    def _data(self, truth: Sequence[int]) -> FloatArray:
        """Return the expected data (p,) in the presence of the true causes."""
        columns = self._columns(truth)
        return self.told + self.G[:, columns] @ self.amounts[columns]

    def _log_evidence(self, chosen: Sequence[int], data: FloatArray) -> float:
        """Return the mean log evidence of a set minus the cost of its causes [nats], relative to the empty set."""
        if not chosen:
            return 0.0
        columns = self._columns(chosen)
        factor = cho_factor(np.eye(len(columns)) + self.G[np.ix_(columns, columns)], lower=True)
        h = data[columns]
        fits = h @ cho_solve(factor, h) + np.trace(cho_solve(factor, self.Q[np.ix_(columns, columns)]))
        return float(0.5 * fits - np.log(np.diag(factor[0])).sum() - self.costs[list(chosen)].sum())

    def _left(self, cause: int, signal: FloatArray, beside: Sequence[int]) -> float:
        """Return the squared norm of a cause's signal that free amounts of the others cannot explain."""
        own = np.arange(self.spans[cause].start, self.spans[cause].stop)
        whole = float(signal @ self.free[np.ix_(own, own)] @ signal)
        if not beside:
            return whole
        columns = self._columns(beside)
        among, to = self.free[np.ix_(columns, columns)], self.free[np.ix_(columns, own)] @ signal
        unit = 1.0 / np.sqrt(np.maximum(np.diag(among), 1e-30))
        fitted = np.linalg.pinv(among * np.outer(unit, unit), rcond=1e-10, hermitian=True) @ (unit * to)
        return max(whole - float((unit * to) @ fitted), 0.0)

    def _columns(self, chosen: Sequence[int]) -> IntArray:
        parts = [np.arange(self.spans[k].start, self.spans[k].stop) for k in chosen]
        return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)

    def _count(self, cause: int) -> int:
        return self.spans[cause].stop - self.spans[cause].start


def whitened(columns: FloatArray, sigma: float, correlation: float, begins: BoolArray) -> FloatArray:
    """Scale columns (n, 3, m) to noise of 1 and flatten them to (3 n, m).

    Args:
        correlation: of neighbouring rows of a run.
        begins: mask of the first rows of runs (n,).
    """
    out = columns / sigma
    if correlation:
        follows = ~begins
        kept = np.zeros_like(out)
        kept[1:] = correlation * out[:-1]
        out = np.where(follows[:, None, None], (out - kept) / math.sqrt(1.0 - correlation**2), out)
    return out.reshape(-1, columns.shape[2])
