"""Learning an arm that is nearly a rigid chain: the chain, and what it errs by, from all pairs at once."""

from __future__ import annotations

import itertools
from dataclasses import asdict
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import BoolArray, FloatArray, rows, rows_or_vector
from kbmaps.chain import RigidChain
from kbmaps.chain_parameters import ChainParameters, ChainTolerances
from kbmaps.errors import KBMapsError, ModelFormatError
from kbmaps.model import Estimate
from kbmaps.packed import numbers, pack, unpack
from kbmaps.pairs import checked_pairs, with_units
from kbmaps.residual_features import ResidualFeatures
from kbmaps.residual_fit import ResidualFit, fit_residual
from kbmaps.rigid_learner import RigidLearner

_KIND = "rigid chain with residual, batch, 1"
# Configurations where the model is surer than this times the least sure pair (in variance) lie where data was.
_SUPPORT_FACTOR = 2.0
_LEAST_FREEDOM = 10.0
# Lumped loads on linear springs are true to some per cent of the yielding that they explain.
_LAW_ERROR = 0.03
_ONE_SIGMA = 0.841344746
_BLOCK = 1024


class ResidualLearner:
    """A rigid chain around a nominal one, and smooth deviations from it where the pairs ask for them.

    Deviations come in groups: eccentric encoders, gear gains, joints that yield under load, a distorting camera, and
    smooth functions of one to three joints. The chain's tolerances and each group's variance are the prior; the
    variances are those that make the pairs most probable, and what is predicted is the average over those sets of
    groups that the pairs speak for. Where they speak for none, this is `RigidLearner` to the last bit.

    Args:
        nominal: the chain as drawn, or as `find_chain` found it.
        tolerances: how far the real one may be from it.
    """

    def __init__(self, nominal: RigidChain, tolerances: ChainTolerances) -> None:
        self._parameters = ChainParameters(nominal)
        self._std = self._parameters.standard_deviations(tolerances)
        self._rigid = RigidLearner(nominal, tolerances)
        self._q, self._x = np.empty((0, nominal.joints)), np.empty((0, 3))
        self._sigma = np.empty(0)
        self._features: ResidualFeatures | None = None
        self._fit: ResidualFit | None = None
        self._widest = 0.0

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return self._parameters.reference.joints

    @property
    def pairs(self) -> int:
        """How many pairs have been learnt."""
        return len(self._q)

    @property
    def rigid(self) -> RigidLearner:
        """The rigid chain that explains the same pairs best; its report has hand-eye, tool centre point and zeros."""
        return self._rigid

    @property
    def chain(self) -> RigidChain:
        """The rigid part of the model."""
        fit = self._fitted()
        return self._rigid.chain if fit is None else fit.chain

    @property
    def deviations(self) -> dict[str, float]:
        """By how much each group of deviations that the pairs speak for moves the learnt positions (RMS) [m]."""
        fit = self._fitted()
        if fit is None or self._features is None:
            return {}
        return self._features.effects(fit.change, fit.chain, fit.weights, self._q)

    @property
    def inliers(self) -> BoolArray:
        """Which pairs (n,), as they came, are no outliers."""
        fit = self._fitted()
        return self._rigid.inliers if fit is None else fit.inliers.copy()

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Pairs q (n, d) [rad, m] and x (n, 3) [m], or one, (d,) and (3,).

        Args:
            sigma: 1-sigma of the positions [m], () or (n,); None where it is to be estimated, as in `RigidLearner`.

        Raises:
            ShapeError, NonFiniteError, SettingError (a sigma that is not positive): nothing has changed.
        """
        angles, positions, sigmas = checked_pairs(q, x, sigma, self.joints)
        self._rigid.learn(q, x, sigma)
        self._q = np.concatenate([self._q, angles])
        self._x = np.concatenate([self._x, positions])
        self._sigma = np.concatenate([self._sigma, sigmas])
        self._features = self._fit = None

    def predict(self, q: ArrayLike) -> FloatArray:
        """Positions (n, 3) [m] at q (n, d), or (3,) at q (d,).

        Raises:
            ShapeError, NonFiniteError
        """
        fit = self._fitted()
        if fit is None or self._features is None:
            return self._rigid.predict(q)
        angles = rows_or_vector("q", q, self.joints)
        x = self._features.positions(fit.chain, fit.weights, np.atleast_2d(angles))
        return x[0] if angles.ndim == 1 else x

    def estimate(self, q: ArrayLike) -> Estimate:
        """Positions at q (n, d), their 1-sigma per axis against the truth, and whether data was there.

        Where the told noise does not explain the residuals, what is left over adds to sigma everywhere.

        Raises:
            ShapeError, NonFiniteError
        """
        fit = self._fitted()
        if fit is None or self._features is None:
            return self._rigid.estimate(q)
        angles = rows("q", q, self.joints)
        x, variance = self._spread(self._features, fit, angles)
        inside = variance.sum(axis=1) <= _SUPPORT_FACTOR * self._widest
        pairs = with_units(self._q, self._x, self._sigma)
        if pairs.known:
            variance = variance + (fit.noise**2 - 1.0) * float(np.square(pairs.unit).mean())
            return Estimate(x, np.sqrt(variance), inside)
        return Estimate(x, np.sqrt(variance) * float(stdtrit(max(fit.freedom, 1.0), _ONE_SIGMA)), inside)

    def to_bytes(self) -> bytes:
        """The learner with all its pairs; `from_bytes` gives the same predictions to the last bit."""
        chain = self._parameters.reference
        arrays = {
            "fixed": chain.fixed,
            "axes": chain.axes,
            "prismatic": chain.prismatic.astype(np.float64),
            "q": self._q,
            "x": self._x,
            "sigma": self._sigma,
        }
        return pack(_KIND, asdict(self._rigid.tolerances), arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The learner in `data`. Raises ModelFormatError: it is none of this kind, or damaged."""
        fields, arrays = unpack(data, _KIND)
        settings = numbers(fields)
        try:
            chain = RigidChain(arrays["fixed"], arrays["axes"], arrays["prismatic"] != 0.0)
            learner = cls(chain, ChainTolerances(**settings))
            sigma = arrays["sigma"]
            told = ~np.isnan(sigma)
            for start, end in _runs(told):
                part = slice(start, end)
                learner.learn(arrays["q"][part], arrays["x"][part], sigma[part] if told[start] else None)
        except (KeyError, TypeError, IndexError, KBMapsError) as error:
            raise ModelFormatError(f"the bytes do not describe a rigid chain with residual: {error}") from error
        return learner

    def _fitted(self) -> ResidualFit | None:
        """The fit; None where the rigid chain is all there is."""
        if self._features is None and self.pairs:
            features = ResidualFeatures(self._parameters, self._q, self._x)
            pairs = with_units(self._q, self._x, self._sigma)
            fit = None
            # Noise that nobody told must be seen in residuals that the chain alone leaves, or anything explains them.
            if pairs.known or self._rigid.report().freedom >= _LEAST_FREEDOM:
                fit = fit_residual(features, self._parameters, self._std, pairs, self._rigid.change)
            if fit is not None:
                _, variance = self._spread(features, fit, self._q[fit.inliers])
                self._widest = float(variance.sum(axis=1).max(initial=0.0))
            self._features, self._fit = features, fit
        return self._fit

    def _spread(self, features: ResidualFeatures, fit: ResidualFit, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions and the variance of each coordinate, both (n, 3)."""
        free = self._std > 0.0
        x, variance = np.empty((len(q), 3)), np.empty((len(q), 3))
        for start in range(0, len(q), _BLOCK):
            part = slice(start, start + _BLOCK)
            point = features.linearised(fit.change, fit.chain, fit.weights, q[part], tuple(fit.weights))
            design = np.concatenate([point.chain[:, :, free] * fit.scales, *point.groups.values()], axis=2)
            x[part], variance[part] = point.x, np.square(design @ fit.spread).sum(axis=2)
            for group in features.approximate(fit.weights):
                move = point.groups[group] @ fit.weights[group]
                variance[part] += _LAW_ERROR**2 / 3.0 * np.square(move).sum(axis=1, keepdims=True)
        return x, variance


def _runs(values: BoolArray) -> list[tuple[int, int]]:
    """Begin and end of each run of equal values."""
    ends = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
    return list(itertools.pairwise(ends)) if len(values) else []
