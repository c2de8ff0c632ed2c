"""Selection of an arm's tolerances by the evidence of its pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainBelief, ChainTolerances

# Candidate tilts of an axis [rad] and shifts [m], 1-sigma, from a milled arm to a kit.
WORKMANSHIP = ((0.0003, 0.0001), (0.001, 0.0005), (0.003, 0.001), (0.01, 0.003), (0.03, 0.01), (0.06, 0.03))
# Less probable tolerances are not considered.
LEAST_SHARE = 0.01
# Narrower tolerances are kept unless wider ones are more probable by more than the inverse of this.
LIKELY = 1.0 / 3.0


@dataclass(frozen=True)
class Tolerances:
    """Candidate tolerances of an arm, with their probability.

    Attributes:
        tolerances: of the nominal chain.
        share: their probability.
    """

    tolerances: ChainTolerances
    share: float


def workmanship(belief: ChainBelief, tolerances: ChainTolerances) -> list[Tolerances]:
    """Return the probable tolerances of the arm, from the evidence of its pairs.

    MacKay 1992, "Bayesian interpolation". The initial tolerances allow for an arm made by hand. Where the nominal chain
    is right to a millimetre, the pairs show it long before they determine each parameter. Narrow tolerances may apply
    to the arm alone, with its joint offsets, or with the cameras' pose too; an infinite tolerance stays infinite.

    Args:
        belief: posterior of the chain.
        tolerances: those of its prior.

    Returns:
        The probable candidates, the narrowest last.
    """
    candidates = [tolerances, *(each for made in reversed(WORKMANSHIP) for each in _narrower(tolerances, *made))]
    kept, shares = probable(np.array([belief.tightened(tolerances, each)[1] for each in candidates]))
    made = {int(k): Tolerances(candidates[k], float(share)) for k, share in zip(kept, shares, strict=True)}
    return [made[k] for k in sorted(made)]


def probable(evidence: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the indices of the probable explanations, the most probable first, and their shares.

    Args:
        evidence: log marginal likelihood of each (m,) (MacKay 1992, "Bayesian interpolation").
    """
    shares = np.exp(evidence - evidence.max())
    shares /= shares.sum()
    kept = np.array([k for k in np.argsort(-shares) if shares[k] > LEAST_SHARE], dtype=np.intp)
    return kept, shares[kept] / shares[kept].sum()


def best_tolerances(belief: ChainBelief, tolerances: ChainTolerances, made: Sequence[Tolerances]) -> ChainBelief:
    """Return the chain nearest to nominal that is not improbable, with the uncertainty of all candidates.

    Its covariance covers all candidate tolerances. Where these explain the pairs equally well, they differ only away
    from the pairs: there the nominal chain is more reliable than the noise.

    Args:
        belief: in an arm of the widest tolerances.
        tolerances: those.
        made: the candidates.
    """
    beliefs = [belief.tightened(tolerances, each.tolerances)[0] for each in made]
    likely = max(each.share for each in made)
    best = max(k for k, each in enumerate(made) if each.share > LIKELY * likely)
    return beliefs[best].among(beliefs, [each.share for each in made])


def _narrower(tolerances: ChainTolerances, angle: float, length: float) -> list[ChainTolerances]:
    axes, points = min(tolerances.axes, angle), min(tolerances.points, length)
    if (axes, points) == (tolerances.axes, tolerances.points):
        return []
    arm = replace(tolerances, axes=axes, points=points)
    zeroed = replace(arm, zeros=min(arm.zeros, angle), slide_zeros=min(arm.slide_zeros, length))
    if math.isinf(tolerances.base_rotation):
        return [arm, zeroed]
    placed = replace(
        zeroed,
        base_rotation=min(zeroed.base_rotation, angle),
        base_translation=min(zeroed.base_translation, length),
    )
    return [arm, zeroed, placed]
