"""False fixes: the marker's reflection, or a lamp somewhere else."""

from __future__ import annotations

import numpy as np

from .arrays import BoolArray, FloatArray
from .eyes import in_view
from .hidden import direction
from .world import Sight, World

LONGEST_RUN = 4  # a reflection stays for some frames
NEAREST_M = 0.06  # nearer to the marker it would be taken for a part of it
INSIDE_PX = 5.0
TRIES = 60


def false_fixes(world: World, sight: Sight, fraction: float, rng: np.random.Generator) -> tuple[FloatArray, BoolArray]:
    """Return seen points [m] in the true left optical frame, a `fraction` of them outliers, and the outlier mask."""
    count = len(sight.at)
    outlier = _runs(count, round(fraction * count), rng)
    points = sight.at.copy()
    mirror, lamps = _mirror(sight.at, rng), _elsewhere(world, sight.at, rng)
    for index in np.flatnonzero(outlier):
        seen = _reflected(sight.at[index], mirror)
        if rng.random() < 0.5 or not in_view(world.arm.eyes, seen[None], INSIDE_PX)[0]:
            seen = lamps[rng.integers(len(lamps))]
            while np.linalg.norm(seen - sight.at[index]) < NEAREST_M:
                seen = lamps[rng.integers(len(lamps))]
        points[index] = seen
    return points, outlier


def _runs(count: int, wanted: int, rng: np.random.Generator) -> BoolArray:
    """Return a mask of `wanted` of `count` places, in short runs."""
    chosen = np.zeros(count, dtype=bool)
    while chosen.sum() < wanted:
        start, length = int(rng.integers(count)), int(rng.integers(1, LONGEST_RUN + 1))
        chosen[start : start + min(length, wanted - int(chosen.sum()))] = True
    return chosen


def _mirror(x: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return a reflecting plane beside the marker's positions: a point and the normal, in the left optical frame."""
    normal = direction(rng)
    along = (x - x.mean(axis=0)) @ normal
    return x.mean(axis=0) + normal * (along.min() - NEAREST_M), normal


def _reflected(x: FloatArray, mirror: tuple[FloatArray, FloatArray]) -> FloatArray:
    point, normal = mirror
    return x - 2.0 * normal * ((x - point) @ normal)


def _elsewhere(world: World, x: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return points in view, far apart from each other."""
    spread = 1.5 * x.std(axis=0) + NEAREST_M
    points = x.mean(axis=0) + rng.normal(size=(TRIES * 20, 3)) * spread
    return points[in_view(world.arm.eyes, points, INSIDE_PX)][:TRIES]
