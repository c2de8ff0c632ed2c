"""Recursive learner of a rigid chain: a filter for each pair, corrected by refits of the last pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, frozen, require_positive, rows_or_vector, vector
from kbmaps.chains.align import PlacedStart
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import (
    CHAIN,
    ChainParameters,
    ChainTolerances,
    chain_arrays,
    chain_from_arrays,
    describe_tolerances,
    parse_tolerances,
)
from kbmaps.chains.rigid_filter import FilterSettings, RigidFilter
from kbmaps.chains.rigid_fit import NO_NOISE_KNOWLEDGE, NoiseKnowledge, RigidFit, fit_chain, folded
from kbmaps.errors import ModelFormatError, SettingError
from kbmaps.model import Estimate, Model, near_data, widest
from kbmaps.packed import complete, count, named, pack, restoring, unpack
from kbmaps.pairs import checked_pairs, stored_pairs, with_units


class _Settings:
    """Settings of the recursive learner.

    Sensitivity: each at 0.3 and 3 times changes error and sigma of a bent arm's models at 150 pairs by less than 1 %,
    but for `growth`, which then does not end, `first` by 4 %.
    """

    min_window: int = 16
    fresh: int = 200  # With few pairs and no prior, an earlier fit may be far off: start from the nominal chain
    # The first refit comes with this pair, the next when the kept pairs have grown by this factor, or the window is
    # full.
    first: int = 8
    growth: float = 1.5
    # A noise estimated from fewer degrees of freedom is a guess: the next refit comes with the next pair.
    sure_freedom: float = 12.0


class RigidWindow:
    """Window of at most `size` pairs. Older ones are folded: linearised at a fit that also used the pairs after them.

    Raises:
        SettingError: size below 16.
    """

    STORED = ("q", "x", "sigma", "known", "farthest")
    STORED_BELIEF = ("before_mean", "before_root")

    def __init__(self, parameters: ChainParameters, tolerances: ChainTolerances, size: int) -> None:
        if size < _Settings.min_window:
            raise SettingError(f"a window must hold at least {_Settings.min_window} pairs, got {size}")
        self.size = size
        # posterior of the chain before the kept pairs
        self.belief = ChainBelief.from_tolerances(parameters, tolerances)
        self.noise = NO_NOISE_KNOWLEDGE  # noise estimated before them, from pairs that came without their sigma
        # variance [m²] of a coordinate that the chain did not explain at the last fit, with the noise given
        self.excess = 0.0
        self._begun = False
        # configuration (1, d) of the folded pair with the largest predicted uncertainty; (0, d) without any
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
        if self._count > _Settings.fresh:
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
            given = self.noise.coordinates + fit.freedom * count / self._count
            self.noise = NoiseKnowledge(min(given, FilterSettings.noise_memory), fit.noise**2)
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


_KIND = "rigid chain, recursive, 5"
_COUNTS = ("pairs", "window", "due")


class RecursiveRigidLearner(Model):
    """Learner that corrects a rigid chain with each pair, and keeps a bounded number of pairs for refits.

    The parameters and the prior are those of `RigidLearner`. A filter processes each pair as it comes. At growing
    intervals the kept pairs are refitted as in `RigidLearner`. A refit re-evaluates outliers and noise, and linearises
    all pairs at the chain found. When the window is full, its older half is folded into a Gaussian.

    Cost with 7 joints: a pair takes 5 µs compiled, 0.27 ms in NumPy, and its share of the refits 0.1 ms once the window
    has filled. A refit takes 5 to 50 ms. Lists, other types than float64 and rows of one pair take 10 µs more.

    Args:
        nominal: the nominal chain.
        tolerances: standard deviations of the real chain about it.
        noise: initial 1-sigma of a coordinate of pairs without their sigma [m]. From the eighth pair on it is estimated
            from the pairs alone.
        window: maximum number of kept pairs. If the arm stays poorly determined for long, as on a guided path that
            moves one joint after the other, a long window is worth its memory (8 (d + 4) bytes a pair).

    Raises:
        SettingError: noise is not positive, or window below 16.

    Example:
        >>> import numpy as np
        >>> from kbmaps import ChainTolerances, RecursiveRigidLearner, RigidChain
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> learner = RecursiveRigidLearner(arm, ChainTolerances(tool=0.1), noise=1e-6)
        >>> learner.learn([0.0, 0.0], [0.5, 0.0, 0.1])  # 100 mm above its nominal position
        >>> learner.predict([0.0, -np.pi / 2]).round(6)
        array([0.2, 0. , 0.2])
    """

    def __init__(
        self, nominal: RigidChain, tolerances: ChainTolerances, *, noise: float = 0.01, window: int = 1000
    ) -> None:
        require_positive("noise", noise, unit=" m")
        self._parameters = ChainParameters(nominal)
        self._tolerances = tolerances
        self._filter = RigidFilter(self._parameters, tolerances, noise)
        self._window = RigidWindow(self._parameters, tolerances, window)
        self._due = _Settings.first
        self._pairs = 0
        self._widest: float | None = None

    @property
    def joints(self) -> int:
        return self.nominal.joints

    @property
    def pairs(self) -> int:
        return self._pairs

    @property
    def kept(self) -> int:
        """Number of kept pairs."""
        return len(self._window)

    @property
    def nominal(self) -> RigidChain:
        """Chain that learning started from."""
        return self._parameters.reference

    @property
    def chain(self) -> RigidChain:
        """Learnt chain."""
        return self._parameters.chain(self._filter.change)

    @property
    def noise(self) -> float:
        """Estimated 1-sigma of a coordinate [m] of the pairs without their own."""
        return math.sqrt(self._filter.noise_square)

    @property
    def change(self) -> FloatArray:
        """Parameters (size,) as in `ChainParameters` (a read-only copy)."""
        return frozen(self._filter.change)

    @property
    def origin(self) -> FloatArray:
        """Change (size,) at which the pairs are linearised (a read-only copy): that of the last refit."""
        return frozen(self._filter.change if self._filter.origin is None else self._filter.origin)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (size, size) of the parameters [rad², m²] (a read-only copy).

        To propagate it to a position, use the derivatives at `origin`.
        """
        return frozen(self._filter.covariance)

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Learn pairs one after the other. In a refit of pairs with and without sigma, sigmas count by their median."""
        self._widest = None
        if self._filter.learn_plain(q, x, sigma, self._window.next_row):
            self._window.next_row_filled()
            self._pairs += 1
            if len(self._window) == self._due:
                self._refit()
            return
        angles, positions, sigmas = checked_pairs(q, x, sigma, self.joints)
        begin = 0
        while begin < len(angles):
            part = slice(begin, begin + self._due - self.kept)
            self._filter.learn(angles[part], positions[part], sigmas[part])
            self._window.add(angles[part], positions[part], sigmas[part])
            self._pairs += len(angles[part])
            begin = part.stop
            if self.kept == self._due:
                self._refit()

    def tool_changed(self, tolerance: float) -> None:
        """Allow for a marker that was moved, by `tolerance` (1-sigma of each component [m]); keep the arm's estimate.

        Raises:
            SettingError: the tolerance is not positive.
        """
        require_positive("tolerance", tolerance, unit=" m")
        if self.kept >= _Settings.first:
            self._window.fold(self._correct_filter(), self.kept)
        before = ChainBelief.from_covariance(self._parameters, self._filter.change, self._filter.covariance)
        belief = before.with_other_tool(tolerance)
        self._filter.go_on_from(belief, fitted=False)
        self._window.begin_with(belief)
        self._widest = None
        self._due = _Settings.first

    def predict(self, q: ArrayLike) -> FloatArray:
        return self._parameters.positions(self._filter.change, rows_or_vector("q", q, self.joints))

    def jacobian(self, q: ArrayLike) -> FloatArray:
        return self._parameters.jacobian(self._filter.change, q)

    def estimate(self, q: ArrayLike) -> Estimate:
        """Return positions with their uncertainty.

        If the residuals of a refit exceed the given noise, the excess is added to sigma everywhere. Support is
        determined by the kept pairs, and by the most uncertain one of those before them. They are evaluated once after
        each `learn` (5 ms at 1,000 kept pairs of 7 joints).
        """
        angles = rows_or_vector("q", q, self.joints)
        x, variance = self._filter.with_variance(np.atleast_2d(angles))
        if self._widest is None:
            self._widest = widest(self._filter.with_variance(self._window.configurations)[1])
        return Estimate(x, np.sqrt(variance + self._window.excess), near_data(variance, self._widest)).like(angles)

    def to_bytes(self) -> bytes:
        counts = {"pairs": self._pairs, "window": self._window.size, "due": self._due}
        arrays = chain_arrays(self.nominal) | self._filter.arrays() | self._window.arrays()
        return pack(_KIND, {"tolerances": describe_tolerances(self._tolerances), **counts}, arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        fields, arrays = unpack(data, _KIND)
        with restoring("a recursive rigid learner"):
            settings = named(fields, "the fields", ("tolerances", *_COUNTS))
            pairs, window, due = (count(settings[name], f"the field {name}") for name in _COUNTS)
            complete(arrays, (*CHAIN, *RigidFilter.STORED, *RigidWindow.STORED), RigidWindow.STORED_BELIEF)
            learner = cls(chain_from_arrays(arrays), parse_tolerances(settings["tolerances"]), window=window)
            learner._filter.restore(arrays)
            learner._window.restore(arrays)
            if not learner.kept < due <= window or learner.kept > pairs:
                raise ModelFormatError(f"{pairs} pairs and a refit at {due} do not fit {learner.kept} kept of {window}")
        learner._pairs, learner._due = pairs, due
        return learner

    def _refit(self) -> None:
        fit = self._correct_filter()
        if self.kept == self._window.size:
            self._window.fold(fit, self.kept // 2)
            self._due = self._window.size
        elif self._window.finds_noise and fit.freedom + self._window.noise.coordinates < _Settings.sure_freedom:
            self._due = self.kept + 1
        else:
            self._due = min(math.ceil(_Settings.growth * self.kept), self._window.size)

    def _correct_filter(self) -> RigidFit:
        """Set the filter to a fit of the kept pairs, and return the fit."""
        fit = self._window.fitted(self._filter.change)
        self._filter.go_on_from(fit.belief, fitted=True)
        if self._window.finds_noise:
            self._filter.noise_square = max(fit.noise, FilterSettings.min_noise_m) ** 2
            coordinates = fit.freedom + self._window.noise.coordinates
            fewest, most = FilterSettings.noise_coordinates, FilterSettings.noise_memory
            self._filter.noise_coordinates = float(np.clip(coordinates, fewest, most))
        return fit
