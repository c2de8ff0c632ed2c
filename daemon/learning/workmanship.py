"""How well an arm is made, as its pairs tell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from kbmaps import ChainBelief, ChainTolerances

# Tilt of an axis [rad] and its shift [m], 1-sigma, from a milled arm to a kit.
WORKMANSHIP = ((0.0003, 0.0001), (0.001, 0.0005), (0.003, 0.001), (0.01, 0.003), (0.03, 0.01), (0.06, 0.03))


def likely_tolerances(belief: ChainBelief, tolerances: ChainTolerances) -> ChainTolerances:
    """The tolerances under which the pairs are most probable (type-II maximum likelihood, MacKay 1992).

    Those that learning begins with have room for an arm made by hand. Where the drawing is right to a millimetre, the
    pairs say so long before they show it number by number. Well made may be the arm alone, with its zeros, or with the
    cameras' place too; an infinite tolerance stays, nobody claims to know that.

    Args:
        belief: what the pairs let believe of the chain.
        tolerances: those that it began with.
    """
    candidates = [tolerances, *(each for made in WORKMANSHIP for each in _narrower(tolerances, *made))]
    evidence = [belief.tightened(tolerances, each)[1] for each in candidates]
    return candidates[int(np.argmax(evidence))]


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
