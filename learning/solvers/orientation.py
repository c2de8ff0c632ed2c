"""Batch solver of orientations: the rigid chain with its marker's rotation, and maps of e1, e2, e3 around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps import (
    ChainBelief,
    ExactLearner,
    JointBasis,
    KBMap,
    Memory,
    OrientedChain,
    SettingError,
    blockwise_precision,
    fitted_orientation,
    rotation_matrices,
)
from kbmaps.arrays import evenly_spread


class BatchSettings:
    # Number of the newest pairs that exact maps are fitted to, which bounds time and memory. Measured where a chain
    # misses 10 mm (docs/results/learning.md).
    window = 20_000
    # Number of the newest pairs kept as pairs, and of those that a chain is fitted to, evenly spread.
    kept, fitted = 4000, 1000
    # Growth of the number of pairs before the next solution, with a new search for the maps' precision; the chain with
    # residual waits for it too, since it takes up to a second.
    growth = 1.15
    min_for_map = 30  # Minimum number of orientations for a map: with fewer, the chain suffices


# An entry of a rotation matrix errs by this much of a small turn's 1-sigma about one axis: √(2/3).
ENTRY_OF_TURN = 0.8165


@dataclass(frozen=True)
class OrientationSolution:
    pairs: int  # number of pairs with an orientation
    chain: OrientedChain  # the rigid chain
    # 12 planes, of which those of e1, e2, e3 count; None if a map would be too large, or the pairs too few
    map: KBMap | None = None
    map_noise: float = 0.0  # 1-sigma of an orientation about one axis around the map [rad]


class OrientationSolver:
    """Solver that keeps the pairs with an orientation.

    Args:
        bases: bases of the learnt maps.
        with_map: True if a map of these bases is small enough to be solved for.
    """

    def __init__(self, bases: tuple[JointBasis, ...], *, with_map: bool) -> None:
        self._bases, self._with_map = bases, with_map
        self._q, self._x, self._turns = np.empty((0, len(bases))), np.empty((0, 3)), np.empty((0, 4))
        self._exact: ExactLearner | None = None
        self._fed = self._pairs = self._solved_at = 0

    @property
    def due(self) -> bool:
        """True if there are enough new orientations for another solution."""
        return self._pairs > 0 and self._pairs >= BatchSettings.growth * self._solved_at

    def learn(self, q: FloatArray, x: FloatArray, turns: FloatArray) -> None:
        """Add pairs q (n, d), x (n, 3) and quaternions (n, 4), NaN for a pair without one."""
        has_orientation = np.isfinite(turns).all(axis=1)
        self._pairs += int(has_orientation.sum())
        self._q, self._x = np.vstack([self._q, q[has_orientation]]), np.vstack([self._x, x[has_orientation]])
        self._turns = np.vstack([self._turns, turns[has_orientation]])
        if self._exact is not None:
            self._feed(self._exact)
        kept = BatchSettings.kept
        self._q, self._x, self._turns = self._q[-kept:], self._x[-kept:], self._turns[-kept:]

    def solve(self, belief: ChainBelief) -> OrientationSolution:
        """Return the solution around the posterior of the chain; at least one orientation is required."""
        self._solved_at = self._pairs
        chosen = evenly_spread(len(self._q), BatchSettings.fitted)
        chain = fitted_orientation(belief, self._q[chosen], self._turns[chosen])
        if not self._with_map or self._pairs < BatchSettings.min_for_map:
            return OrientationSolution(self._pairs, chain)
        prior = chain.chain.to_kbmap(self._bases, orientation=True)
        if self._exact is None:
            self._exact = ExactLearner(prior, memory=Memory(window=BatchSettings.window))
            self._fed = self._pairs - len(self._q)
            self._feed(self._exact)
        self._exact.rebase(prior)
        try:
            solution = self._exact.solve(self._precision(prior))
        except SettingError:  # lost in rounding: the chain keeps answering
            return OrientationSolution(self._pairs, chain)
        noise = (solution.orientation_noise_std or 0.0) / ENTRY_OF_TURN
        return OrientationSolution(self._pairs, chain, solution.map, noise if math.isfinite(noise) else 0.0)

    def _precision(self, prior: KBMap) -> float:
        """Return the precision chosen by left-out blocks for axis e1, since neighbours on a path share their errors."""
        axis = KBMap(prior.bases, prior.net[3:6])
        rotations = rotation_matrices("turns", self._turns)
        return blockwise_precision(axis, self._q, rotations[:, :, 0])

    def _feed(self, exact: ExactLearner) -> None:
        new = self._pairs - self._fed
        if new:
            exact.learn(self._q[-new:], self._x[-new:], rotation=self._turns[-new:])
        self._fed = self._pairs
