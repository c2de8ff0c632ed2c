"""Selection of an arm's tolerances by the evidence of its pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainBelief, ChainTolerances
from kbmaps.arrays import evenly_spread
from kbmaps.robust import RobustSettings


class ToleranceSettings:
    # Candidate tilts of an axis [rad] and shifts [m], 1-sigma, from a milled arm to a kit.
    candidates = ((0.0003, 0.0001), (0.001, 0.0005), (0.003, 0.001), (0.01, 0.003), (0.03, 0.01), (0.06, 0.03))
    compared_pairs = 100  # pairs at which candidates are compared with the posterior, evenly spread
    min_share = 0.01  # less probable tolerances are not considered
    # narrower tolerances are kept unless wider ones are more probable by more than the inverse of this
    likely = 1.0 / 3.0


@dataclass(frozen=True)
class Tolerances:
    """Candidate tolerances of an arm, with their probability."""

    tolerances: ChainTolerances  # of the nominal chain
    share: float  # their probability


def select_tolerances(belief: ChainBelief, tolerances: ChainTolerances, q: FloatArray) -> list[Tolerances]:
    """Return the probable tolerances of the arm, from the evidence of its pairs.

    MacKay 1992, "Bayesian interpolation". The initial tolerances allow for an arm made by hand. If the nominal chain is
    right to a millimetre, the pairs show it long before they determine each parameter. Narrow tolerances may apply to
    the arm alone, with its joint offsets, or with the cameras' pose too; an infinite tolerance stays infinite.

    Args:
        belief: posterior of the chain.
        tolerances: those of its prior.
        q: configurations (n, d) [rad] of its pairs, or of a part of them.

    Returns:
        The probable candidates, the narrowest last.
    """
    q = q[evenly_spread(len(q), ToleranceSettings.compared_pairs)]
    order = reversed(ToleranceSettings.candidates)
    candidates = [tolerances, *(each for selected in order for each in _narrower(tolerances, *selected))]
    narrowed = [belief.tightened(tolerances, each) for each in candidates]
    losses = _nonlinearity_loss(belief, [found for found, _ in narrowed], q)
    kept, shares = probable_indices(np.array([evidence for _, evidence in narrowed]) - losses)
    selected = {int(k): Tolerances(candidates[k], float(share)) for k, share in zip(kept, shares, strict=True)}
    return [selected[k] for k in sorted(selected)]


def _nonlinearity_loss(belief: ChainBelief, narrowed: Sequence[ChainBelief], q: FloatArray) -> FloatArray:
    """Return the evidence [nats] that narrower posteriors (m,) lose because positions are nonlinear in the parameters.

    A narrower prior moves the undetermined parameters along a tangent. If the pairs are precise, the positions at the
    end of the tangent do not fit them. The loss is that of the evidence's variational lower bound: half the growth of
    the expected sum of squares. That is counted in units of the posterior's covariance at the pairs, of which the k
    parameters have k in all (our derivation, from the trace identity Σ tr(J C Jᵀ) / σ² = k).
    """
    x, jacobian = belief.parameters.linearised(belief.mean, q)
    spread = jacobian @ belief.root
    roots = np.linalg.cholesky(spread @ spread.mT + RobustSettings.rounding_m**2 * np.eye(3))

    def square(columns: FloatArray) -> float:
        return float(np.square(np.linalg.solve(roots, columns)).sum(axis=2).mean())

    growths = list[float]()
    for each in narrowed:
        x_there, jacobian_there = each.parameters.linearised(each.mean, q)
        curvature = x_there - x - jacobian @ (each.mean - belief.mean)
        growths.append(square(curvature[..., None]) + square(jacobian_there @ each.root) - square(jacobian @ each.root))
    return 0.5 * belief.root.any(axis=1).sum() * np.maximum(growths, 0.0)


def probable_indices(evidence: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the indices of the probable explanations, the most probable first, and their probabilities.

    Args:
        evidence: log marginal likelihood of each (m,) (MacKay 1992, "Bayesian interpolation").
    """
    shares = np.exp(evidence - evidence.max())
    shares /= shares.sum()
    kept = np.array([k for k in np.argsort(-shares) if shares[k] > ToleranceSettings.min_share], dtype=np.intp)
    return kept, shares[kept] / shares[kept].sum()


def best_tolerances(belief: ChainBelief, tolerances: ChainTolerances, candidates: Sequence[Tolerances]) -> ChainBelief:
    """Return the chain nearest to nominal that is not improbable, with the uncertainty of all candidates.

    Its covariance covers all candidate tolerances. If these explain the pairs equally well, they differ only away from
    the pairs: there the nominal chain is more reliable than the noise.

    Args:
        belief: posterior for an arm of the widest tolerances.
        tolerances: the widest tolerances.
        candidates: the candidates.
    """
    beliefs = [belief.tightened(tolerances, each.tolerances)[0] for each in candidates]
    likely = max(each.share for each in candidates)
    best = max(k for k, each in enumerate(candidates) if each.share > ToleranceSettings.likely * likely)
    return beliefs[best].with_mixture_covariance(beliefs, [each.share for each in candidates])


def _narrower(tolerances: ChainTolerances, angle: float, length: float) -> list[ChainTolerances]:
    axes, points = min(tolerances.axes, angle), min(tolerances.points, length)
    if (axes, points) == (tolerances.axes, tolerances.points):
        return []
    arm = replace(tolerances, axes=axes, points=points)
    zeroed = replace(arm, zeros=min(arm.zeros, angle), slide_zeros=min(arm.slide_zeros, length))
    if math.isinf(tolerances.base_rotation):
        return [arm, zeroed]
    placed = replace(
        zeroed, base_rotation=min(zeroed.base_rotation, angle), base_translation=min(zeroed.base_translation, length)
    )
    return [arm, zeroed, placed]
