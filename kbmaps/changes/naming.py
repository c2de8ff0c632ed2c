"""Which part of the chain changed, of all pairs since a change together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.chains.belief import ChainBelief
from kbmaps.changes.kinds import OTHER, ChangeKind
from kbmaps.changes.mixture import SIZES
from kbmaps.robust import OUTLIER_SIGMAS

# Of more pairs so many are looked at, evenly spread. They stand for themselves alone: counted for the others too, their
# noise would look like a change of everything.
MOST_PAIRS = 400
_STEPS = 6


@dataclass(frozen=True, eq=False)
class Explanation:
    """One kind of change, as far as the pairs since then speak for it.

    Attributes:
        kind: the part of the chain.
        probability: that it is this one.
        change: of the kind's parameters, most probable (k,) [rad, m].
        moved_m: by how much that moves the marker at these pairs, root mean square [m].
    """

    kind: ChangeKind
    probability: float
    change: FloatArray
    moved_m: float


def explanations(
    before: ChainBelief,
    kinds: Sequence[ChangeKind],
    q: FloatArray,
    x: FloatArray,
    noise_m: float,
    shared: float = 1.0,
) -> list[Explanation]:
    """How probable each kind of change is, the most probable first.

    For each kind the most probable change is found together with what was not known of the chain before. The evidence
    for it is that of a Gaussian around it (Laplace), averaged over the sizes that a change may have. So one number that
    does as well as three is more probable, and what these pairs cannot tell apart stays undecided.

    Args:
        before: what is believed of the chain by the pairs before the change.
        kinds: what may have changed.
        q: pairs since then, joint values (n, d) [rad, m].
        x: what of the measured positions (n, 3) [m] the chain shall explain.
        noise_m: 1-sigma of a coordinate [m].
        shared: how many neighbours say as much as one would.
    """
    chosen = np.linspace(0, len(q) - 1, min(len(q), MOST_PAIRS)).round().astype(np.intp)
    q, x, counted = q[chosen], x[chosen], 1.0 / shared
    sizes = noise_m * np.array(SIZES)
    fits = [_fit(before, kind, q, x, noise_m, counted, float(sizes[-1])) for kind in kinds]
    # A change of everything at once that is hardly seen is what was not known before, and no change.
    logs = np.array(
        [
            np.log(kind.share) + fit.evidence(sizes[1:] if kind.name == OTHER else sizes)
            for kind, fit in zip(kinds, fits, strict=True)
        ]
    )
    shares = np.exp(logs - np.logaddexp.reduce(logs))
    found = [
        Explanation(kind, float(share), fit.change * kind.units, fit.moved_m)
        for kind, share, fit in zip(kinds, shares, fits, strict=True)
    ]
    return sorted(found, key=lambda each: -each.probability)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A change that was fitted, in metres of the marker's way.

    Attributes:
        cost: minus the log likelihood there, with what the belief before says.
        log_volume: of what was not known before, ½ log det of its precision.
        information: of the change with the rest unknown (k, k).
        change: (k,) [m].
        moved_m: see `Explanation`.
    """

    cost: float
    log_volume: float
    information: FloatArray
    change: FloatArray
    moved_m: float

    def evidence(self, sizes: FloatArray) -> float:
        values, vectors = np.linalg.eigh(self.information)
        along = np.square(vectors.T @ self.change)
        widened = 1.0 + np.square(sizes)[:, None] * np.maximum(values, 0.0)
        spent = 0.5 * (values * along / widened + np.log(widened)).sum(axis=1)
        return float(np.logaddexp.reduce(-spent)) - np.log(len(sizes)) - self.cost - self.log_volume


def _fit(
    before: ChainBelief, kind: ChangeKind, q: FloatArray, x: FloatArray, noise_m: float, counted: float, widest: float
) -> _Fit:
    """The most probable change of this kind; each pair counts as `counted`, a change is seldom larger than `widest`."""
    root = before.root[:, np.square(before.root).any(axis=0)]
    known, size = root.shape[1], len(kind.columns)
    to_change = np.zeros((before.parameters.size, known + size))
    to_change[:, :known] = root
    to_change[kind.columns, known + np.arange(size)] = kind.units
    prior = np.r_[np.ones(known), np.full(size, widest**-2.0)]
    numbers = np.zeros(known + size)
    limit = OUTLIER_SIGMAS
    for step in range(_STEPS):
        predicted, jacobian = before.parameters.linearised(before.mean + to_change @ numbers, q)
        design = (jacobian @ to_change) / noise_m
        off = (x - predicted) / noise_m
        far = np.linalg.norm(off, axis=1)
        # Beyond the limit less and less, at last not at all: at first it is wide, since nothing is fitted yet.
        wide = limit if step >= _STEPS // 2 else max(limit, 3.0 * float(np.median(far)))
        weights = counted * (far <= wide)
        normal = _squared(design, weights) + np.diag(prior)
        slope = (design * weights[:, None, None]).reshape(-1, len(prior)).T @ off.ravel() - prior * numbers
        numbers = numbers + cast(FloatArray, np.linalg.solve(normal, slope))
    return _described(before, to_change, known, numbers, q, x, noise_m, counted)


def _described(
    before: ChainBelief,
    to_change: FloatArray,
    known: int,
    numbers: FloatArray,
    q: FloatArray,
    x: FloatArray,
    noise_m: float,
    counted: float,
) -> _Fit:
    predicted, jacobian = before.parameters.linearised(before.mean + to_change @ numbers, q)
    design = (jacobian @ to_change) / noise_m
    squares = np.square((x - predicted) / noise_m).sum(axis=1)
    weights = counted * (squares <= OUTLIER_SIGMAS**2)
    normal = _squared(design, weights)
    of_known = normal[:known, :known] + np.eye(known)
    crossed = normal[:known, known:]
    information = normal[known:, known:] - crossed.T @ cast(FloatArray, np.linalg.solve(of_known, crossed))
    cost = 0.5 * counted * float(np.minimum(squares, OUTLIER_SIGMAS**2).sum())
    cost += 0.5 * float(numbers[:known] @ numbers[:known])
    _, log_det = np.linalg.slogdet(of_known)
    unchanged = before.parameters.positions(before.mean + to_change[:, :known] @ numbers[:known], q)
    moved_m = float(np.sqrt(np.square(predicted - unchanged).sum(axis=1).mean()))
    return _Fit(cost, 0.5 * float(log_det), information, numbers[known:], moved_m)


def _squared(design: FloatArray, weights: FloatArray) -> FloatArray:
    """Σ_n w_n D_nᵀ D_n (k, k) of derivatives D (n, 3, k) and weights (n,)."""
    rows = design.reshape(-1, design.shape[2])
    return (rows * np.repeat(weights, design.shape[1])[:, None]).T @ rows
