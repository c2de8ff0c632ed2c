"""Window of the last pairs of a rigid chain, refitted together, and the posterior from the pairs before it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from kbmaps.arrays import FloatArray, vector
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.parameters import ChainParameters, ChainTolerances
from kbmaps.chains.placed_start import PlacedStart
from kbmaps.chains.rigid_fit import NOTHING_KNOWN, NoiseKnowledge, RigidFit, fit_chain, folded
from kbmaps.errors import ModelFormatError, SettingError
from kbmaps.pairs import stored_pairs, with_units

LEAST_WINDOW = 16
# With few pairs and no prior, an earlier fit may be far off: start from the nominal chain.
_FRESH = 200
# Upper bound of the number of coordinates that older pairs contribute to the noise estimate.
_NOISE_MEMORY = 900.0


class RigidWindow:
    """Keeps at most `size` pairs. Older ones are folded: linearised at a fit that also used the pairs after them.

    Attributes:
        belief: posterior of the chain before the kept pairs.
        noise: noise estimated before them, from pairs that came without their sigma.
        farthest: configuration (1, d) of the folded pair with the largest predicted uncertainty; (0, d) without any.
        excess: variance [m²] of a coordinate that the chain did not explain at the last fit, with the noise given.

    Raises:
        SettingError: size below 16.
    """

    STORED = ("q", "x", "sigma", "known", "farthest")
    STORED_BELIEF = ("before_mean", "before_root")

    def __init__(self, parameters: ChainParameters, tolerances: ChainTolerances, size: int) -> None:
        if size < LEAST_WINDOW:
            raise SettingError(f"a window must hold at least {LEAST_WINDOW} pairs, got {size}")
        self.size = size
        self.belief = ChainBelief.from_tolerances(parameters, tolerances)
        self.noise = NOTHING_KNOWN
        self.excess = 0.0
        self._begun = False
        self.farthest = np.empty((0, parameters.reference.joints))
        self._place = PlacedStart(parameters, tolerances)
        self._joints, self._count = parameters.reference.joints, 0
        # q, x and sigma side by side
        self._rows = np.empty((size, self._joints + 4))

    def __len__(self) -> int:
        return self._count

    @property
    def configurations(self) -> FloatArray:
        """Configurations (n, d) of the kept pairs, and the most uncertain one of the folded pairs."""
        return np.concatenate([self._rows[: self._count, : self._joints], self.farthest])

    @property
    def finds_noise(self) -> bool:
        """True if a pair came without its sigma."""
        return bool(np.isnan(self._rows[: self._count, -1]).any())

    def add(self, q: FloatArray, x: FloatArray, sigma: FloatArray) -> None:
        """Add checked pairs q (n, d), x (n, 3) and sigma (n,), NaN where unknown; they must fit into the window."""
        rows = self._rows[self._count : self._count + len(q)]
        rows[:, : self._joints], rows[:, self._joints : -1], rows[:, -1] = q, x, sigma
        self._count += len(q)

    @property
    def next_row(self) -> FloatArray:
        """Row of the next pair: q, x and sigma side by side (d + 4)."""
        return self._rows[self._count]

    def next_row_filled(self) -> None:
        """Count the pair that was written to `next_row`."""
        self._count += 1

    def fitted(self, near: FloatArray) -> RigidFit:
        """Return the fit to at least one pair; `near` (size,) is the expected change of the chain."""
        q, x, sigma = self._pairs()
        pairs = with_units(q, x, sigma)
        if self._count > _FRESH:
            fit = fit_chain(self.belief, pairs, near, near=True, noise=self.noise)
        else:
            start = self.belief.mean if self._begun else self._place.change(q, x)
            fit = fit_chain(self.belief, pairs, start, noise=self.noise)
        self.excess = (fit.noise**2 - 1.0) * float(np.square(pairs.unit).mean()) if pairs.known else 0.0
        return fit

    def fold(self, fit: RigidFit, count: int) -> None:
        """Fold the oldest `count` pairs into the belief, after a fit to all kept pairs."""
        q, x, sigma = self._pairs()
        # The units are those of the fit, hence of all pairs.
        pairs = with_units(q, x, sigma)
        good = fit.inliers & (np.arange(self._count) < count)
        candidates = np.concatenate([q[good], self.farthest])
        _, variance = fit.belief.predict_with_variance(candidates)
        self.farthest = candidates[np.argsort(-variance.sum(axis=1))[:1]]
        self.belief = folded(self.belief, pairs.chosen(good), fit.belief.mean, fit.noise)
        if not pairs.known:
            told = self.noise.coordinates + fit.freedom * count / self._count
            self.noise = NoiseKnowledge(min(told, _NOISE_MEMORY), fit.noise**2)
        self._begun = True
        self._count -= count
        self._rows[: self._count] = self._rows[count : count + self._count].copy()

    def begin_with(self, belief: ChainBelief) -> None:
        """Drop all pairs and start from `belief`."""
        self.belief, self._begun, self._count = belief, True, 0
        self.farthest = self.farthest[:0]

    def arrays(self) -> dict[str, FloatArray]:
        """Return the state as arrays for `kbmaps.packed`."""
        q, x, sigma = self._pairs()
        known = np.array([self.noise.coordinates, self.noise.square, self.excess])
        arrays = {"q": q, "x": x, "sigma": sigma, "known": known, "farthest": self._stored_farthest()}
        return arrays | ({"before_mean": self.belief.mean, "before_root": self.belief.root} if self._begun else {})

    def restore(self, arrays: Mapping[str, FloatArray]) -> None:
        """Restore the state from `arrays`.

        Raises:
            ModelFormatError, KeyError, ValueError, ShapeError, NonFiniteError, SettingError: invalid state.
        """
        q, x, sigma = stored_pairs(arrays, self._joints)
        coordinates, square, excess = (float(number) for number in vector("known", arrays["known"], 3))
        farthest = self._farthest(arrays["farthest"])
        known = all(0.0 <= number < math.inf for number in (coordinates, square, excess))
        if len(q) > self.size or not known:
            raise ModelFormatError("the stored pairs do not fit their window, or their noise is invalid")
        if "before_mean" in arrays:
            self.begin_with(ChainBelief(self.belief.parameters, arrays["before_mean"], arrays["before_root"]))
        self.noise, self.excess, self.farthest = NoiseKnowledge(coordinates, square), excess, farthest
        self.add(q, x, sigma)

    def _stored_farthest(self) -> FloatArray:
        """Return `farthest` as a vector (d,); NaN if there is none."""
        return self.farthest[0] if len(self.farthest) else np.full(self._joints, np.nan)

    def _farthest(self, stored: FloatArray) -> FloatArray:
        """Restore the result of `_stored_farthest`. Raises ShapeError, NonFiniteError."""
        if stored.shape == (self._joints,) and np.isnan(stored).all():
            return np.empty((0, self._joints))
        return vector("farthest", stored, self._joints)[None]

    def _pairs(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        rows = self._rows[: self._count]
        # C order, as it comes back from bytes: sums must not depend on the layout.
        q, x, sigma = rows[:, : self._joints], rows[:, self._joints : -1], rows[:, -1]
        return np.ascontiguousarray(q), np.ascontiguousarray(x), np.ascontiguousarray(sigma)
