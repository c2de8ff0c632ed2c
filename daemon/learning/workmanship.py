"""How well an arm is made, as its pairs tell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainBelief, ChainTolerances

# Tilt of an axis [rad] and its shift [m], 1-sigma, from a milled arm to a kit.
WORKMANSHIP = ((0.0003, 0.0001), (0.001, 0.0005), (0.003, 0.001), (0.01, 0.003), (0.03, 0.01), (0.06, 0.03))
# Workmanship that is less probable than this is not considered.
LEAST_SHARE = 0.01
# So many times as probable another way has to be before an arm is taken to be made worse.
LIKELY = 1.0 / 3.0


@dataclass(frozen=True)
class Made:
    """How an arm may be made, and how probable that is.

    Attributes:
        tolerances: those that the nominal chain is drawn to.
        share: the probability.
    """

    tolerances: ChainTolerances
    share: float


def workmanship(belief: ChainBelief, tolerances: ChainTolerances) -> list[Made]:
    """How the arm may be made, from the evidence of its pairs (MacKay 1992, "Bayesian interpolation").

    The tolerances that learning begins with have room for an arm made by hand. Where the drawing is right to a
    millimetre, the pairs say so long before they show it number by number. Well made may be the arm alone, with its
    zeros, or with the cameras' place too; an infinite tolerance stays, nobody claims to know that.

    Args:
        belief: what the pairs let believe of the chain.
        tolerances: those that it began with.

    Returns:
        The probable ways, the best workmanship last.
    """
    candidates = [tolerances, *(each for made in reversed(WORKMANSHIP) for each in _narrower(tolerances, *made))]
    kept, shares = probable(np.array([belief.tightened(tolerances, each)[1] for each in candidates]))
    made = {int(k): Made(candidates[k], float(share)) for k, share in zip(kept, shares, strict=True)}
    return [made[k] for k in sorted(made)]


def probable(evidence: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Which of several explanations are probable at all, the most probable first, and their shares.

    Args:
        evidence: log marginal likelihood of each (m,) (MacKay 1992, "Bayesian interpolation").
    """
    shares = np.exp(evidence - evidence.max())
    shares /= shares.sum()
    kept = np.array([k for k in np.argsort(-shares) if shares[k] > LEAST_SHARE], dtype=np.intp)
    return kept, shares[kept] / shares[kept].sum()


def best_made(belief: ChainBelief, tolerances: ChainTolerances, made: Sequence[Made]) -> ChainBelief:
    """The chain that is nearest to its drawing without being improbable, as far as it may be another one.

    What is claimed of it is that of all the ways in which it may be made. But where these explain the pairs alike, they
    differ in places without pairs only: there the drawing says more than the noise does.

    Args:
        belief: in an arm of the widest tolerances.
        tolerances: those.
        made: the ways.
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
