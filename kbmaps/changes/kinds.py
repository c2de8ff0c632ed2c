"""Kinds of change of a running arm, the marker motion that each causes, and their identification from later pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from kbmaps.arrays import FloatArray, IntArray, evenly_spread
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.parameters import ChainParameters
from kbmaps.robust import RobustSettings


class KindSettings:
    # Sizes of a change over the noise of one measurement, equally probable: from a fraction of it to far beyond it.
    sizes = (0.5, 2.5, 12.0, 60.0)
    # A change of everything is seldom what happened if a change of one part explains the pairs as well.
    other_share = 0.001
    # Maximum number of pairs, evenly spread. They are not weighted up for the others: their noise would look like a
    # change of everything.
    max_pairs = 400
    steps = 6


def log_ratios(information: FloatArray, score: FloatArray, sizes: FloatArray) -> FloatArray:
    """Return the log likelihood ratio of a change θ ~ N(0, s² 1) to none, averaged over the sizes s, (m,).

    With a linear model's information G and score u = G θ̂ about θ, and in G's eigenvectors:

        log Λ_s = ½ Σ_j u_j² s² / (1 + s² g_j) − ½ Σ_j log(1 + s² g_j)

    Without a change its expectation is 1, whatever the prior (Lai 1998, "Information bounds and quick detection of
    parameter changes in stochastic systems").

    Args:
        information: G (m, k, k).
        score: u (m, k).
        sizes: s (s,), in θ's units.
    """
    if score.shape[1] == 1:
        values, along = information[:, :, 0], score
    else:
        values, vectors = np.linalg.eigh(information)
        along = np.matvec(vectors.transpose(0, 2, 1), score)
    squares = np.square(sizes)[:, None]
    widened = 1.0 + squares * np.maximum(values, 0.0)[:, None]
    ratios = 0.5 * (squares * np.square(along)[:, None] / widened - np.log(widened)).sum(axis=2)
    return np.logaddexp.reduce(ratios, axis=1) - np.log(len(sizes))


TOOL, CAMERA, JOINT, OTHER = "tool", "camera", "joint", "other"


@dataclass(frozen=True, eq=False)
class ChangeKind:
    """Part of the chain that may change from some pair on.

    Attributes:
        name: `tool`, `camera`, `joint` or `other`.
        joint: index of the joint (from 0) whose offset changed, otherwise None.
        columns: the parameters (k,) that change, as in `ChainParameters`.
        units: change of each that moves the marker by about a metre (k,) [rad/m, m/m].
        share: prior probability of this kind.
    """

    name: str
    joint: int | None
    columns: IntArray
    units: FloatArray
    share: float


def change_kinds(parameters: ChainParameters, distance_m: float) -> tuple[ChangeKind, ...]:
    """Return the kinds tool, camera, and each joint's offset, equally probable; the joints share one third.

    Args:
        distance_m: usual distance from the camera to the marker [m].
    """
    camera = np.r_[parameters.base_turn, parameters.base_shift]
    turned = np.r_[np.full(3, 1.0 / max(distance_m, 1e-3)), np.ones(3)] / math.sqrt(2.0)
    kinds = [
        ChangeKind(TOOL, None, np.r_[parameters.tool], np.ones(3), 1.0 / 3.0),
        ChangeKind(CAMERA, None, camera, turned, 1.0 / 3.0),
    ]
    zeros = np.arange(parameters.size)[parameters.zeros]
    for joint, column in enumerate(zeros):
        unit = 1.0 if parameters.reference.prismatic[joint] else 1.0 / parameters.reach
        kinds.append(ChangeKind(JOINT, joint, np.array([column]), np.array([unit]), 1.0 / (3.0 * len(zeros))))
    return tuple(kinds)


def any_change(parameters: ChainParameters) -> ChangeKind:
    """Return the change of everything at once, for a change that no single part explains."""
    units = np.where(parameters.turning, 1.0 / parameters.reach, 1.0) / math.sqrt(parameters.size / 3.0)
    return ChangeKind(OTHER, None, np.arange(parameters.size), units, KindSettings.other_share)


@dataclass(frozen=True, eq=False)
class Explanation:
    """Evidence for one kind of change in the pairs since then.

    Attributes:
        kind: the part of the chain.
        probability: probability of this kind.
        change: most probable change of the kind's parameters (k,) [rad, m].
        moved_m: motion of the marker caused by it at these pairs, root mean square [m].
    """

    kind: ChangeKind
    probability: float
    change: FloatArray
    moved_m: float


def explanations(
    before: ChainBelief, kinds: Sequence[ChangeKind], q: FloatArray, x: FloatArray, noise_m: float, shared: float = 1.0
) -> list[Explanation]:
    """Return the probability of each kind of change, the most probable first.

    For each kind, the most probable change is fitted together with the chain's prior uncertainty. Its evidence is that
    of a Gaussian around it (Laplace), averaged over the possible sizes of a change. So of two equally good fits, the
    one with fewer parameters is more probable, and kinds that these pairs cannot separate stay undecided.

    Args:
        before: posterior of the chain from the pairs before the change.
        q: pairs since then, joint values (n, d) [rad, m].
        x: the part of the measured positions (n, 3) [m] that the chain must explain.
        noise_m: 1-sigma of a coordinate [m].
        shared: number of neighbours that carry as much information as one independent pair.
    """
    chosen = evenly_spread(len(q), KindSettings.max_pairs)
    q, x, counted = q[chosen], x[chosen], 1.0 / shared
    sizes = noise_m * np.array(KindSettings.sizes)
    fits = [_fit(before, kind, q, x, noise_m, counted, float(sizes[-1])) for kind in kinds]
    # A barely visible change of everything is indistinguishable from the prior uncertainty, so small sizes are left
    # out.
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
    """Fitted change, in metres of marker motion."""

    cost: float  # minus the log likelihood there, including the prior belief
    log_volume: float  # of the prior uncertainty, ½ log det of its precision
    information: FloatArray  # of the change with the rest unknown (k, k)
    change: FloatArray  # (k,) [m]
    moved_m: float  # see `Explanation`

    def evidence(self, sizes: FloatArray) -> float:
        values, vectors = np.linalg.eigh(self.information)
        along = np.square(vectors.T @ self.change)
        widened = 1.0 + np.square(sizes)[:, None] * np.maximum(values, 0.0)
        spent = 0.5 * (values * along / widened + np.log(widened)).sum(axis=1)
        return float(np.logaddexp.reduce(-spent)) - np.log(len(sizes)) - self.cost - self.log_volume


def _fit(
    before: ChainBelief, kind: ChangeKind, q: FloatArray, x: FloatArray, noise_m: float, counted: float, widest: float
) -> _Fit:
    """Fit the most probable change of this kind; each pair counts as `counted`, `widest` is the prior's 1-sigma."""
    root = before.root[:, np.square(before.root).any(axis=0)]
    known, size = root.shape[1], len(kind.columns)
    to_change = np.zeros((before.parameters.size, known + size))
    to_change[:, :known] = root
    to_change[kind.columns, known + np.arange(size)] = kind.units
    prior = np.r_[np.ones(known), np.full(size, widest**-2.0)]
    numbers = np.zeros(known + size)
    limit = RobustSettings.outlier_sigmas
    for step in range(KindSettings.steps):
        predicted, jacobian = before.parameters.linearised(before.mean + to_change @ numbers, q)
        design = (jacobian @ to_change) / noise_m
        off = (x - predicted) / noise_m
        far = np.linalg.norm(off, axis=1)
        # The limit starts wide, since nothing is fitted yet, and ends as a hard cut.
        wide = limit if step >= KindSettings.steps // 2 else max(limit, 3.0 * float(np.median(far)))
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
    weights = counted * (squares <= RobustSettings.outlier_sigmas**2)
    normal = _squared(design, weights)
    of_known = normal[:known, :known] + np.eye(known)
    crossed = normal[:known, known:]
    information = normal[known:, known:] - crossed.T @ cast(FloatArray, np.linalg.solve(of_known, crossed))
    cost = 0.5 * counted * float(np.minimum(squares, RobustSettings.outlier_sigmas**2).sum())
    cost += 0.5 * float(numbers[:known] @ numbers[:known])
    _, log_det = np.linalg.slogdet(of_known)
    unchanged = before.parameters.positions(before.mean + to_change[:, :known] @ numbers[:known], q)
    moved_m = float(np.sqrt(np.square(predicted - unchanged).sum(axis=1).mean()))
    return _Fit(cost, 0.5 * float(log_det), information, numbers[known:], moved_m)


def _squared(design: FloatArray, weights: FloatArray) -> FloatArray:
    """Return Σ_n w_n D_nᵀ D_n (k, k) of derivatives D (n, 3, k) and weights (n,)."""
    rows = design.reshape(-1, design.shape[2])
    return (rows * np.repeat(weights, design.shape[1])[:, None]).T @ rows
