"""Batch learner of a rigid chain: the most probable chain, and its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, frozen, numbers, rows_or_vector
from kbmaps.chains.align import PlacedStart
from kbmaps.chains.belief import ChainBelief, squared
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
from kbmaps.chains.report import ChainReport, Scatter, chain_report
from kbmaps.chains.rigid_fit import RigidFit, fit_chain, rough_fit
from kbmaps.errors import DegenerateDataError, ModelFormatError, NonFiniteError, SettingError, ShapeError
from kbmaps.model import Estimate, Model, near_data, widest
from kbmaps.packed import complete, named, pack, restoring, unpack
from kbmaps.pairs import Pairs, checked_pairs, of_covariances, stored_pairs, with_units
from kbmaps.robust import claimed_sigma, student
from kbmaps.variance_components import error_covariances, inverse_roots, is_anisotropic


class _Settings:
    open: float = 0.5  # a direction is open if at least this share of the prior's variance remains
    # No step along a direction changes a parameter by more than this [rad, m]: beyond, the second order does not hold.
    longest_step: float = 0.1
    max_followed_pairs: int = (
        100  # the curvature of the posterior is estimated from about this many evenly spread pairs
    )
    # A parameter counts as undetermined if its standard deviation stayed above this share of the prior's.
    min_remaining_share: float = 0.5


def deviations(belief: ChainBelief, pairs: Pairs, sigma: FloatArray) -> FloatArray:
    """Return the RMS deviation (size,) [rad, m] of each parameter's true value from the mean, to second order.

    Changes that the pairs cannot separate lie along a curve, not along its tangent. An example is a different offset of
    the last joint that the marker compensates: the marker then moves round the joint's axis. With y standard normal
    along the open directions W_o, the closed ones W_c follow, so that the pairs remain equally well explained (our
    derivation):

        θ = m + W_o y + W_c (z + ½ Σ B_kl y_k y_l)    B_kl = −(J W_c)⁺ ∂²x(W_o e_k, W_o e_l)

    Half the quadratic form has the mean tr B / 2 and the variance tr B² / 2.

    Args:
        belief: posterior after the pairs.
        pairs: the n pairs, or representatives of them.
        sigma: 1-sigma (n,) of a coordinate of each [m].
    """
    q = pairs.q
    opened, closed, follow = _sides(belief, pairs, sigma)
    bend = np.empty((len(belief.mean), opened.shape[1], opened.shape[1]))
    for k, direction in enumerate(opened.T):
        step = _Settings.longest_step / max(float(np.abs(direction).max()), _Settings.longest_step)
        _, ahead = belief.parameters.linearised(belief.mean + step * direction, q)
        _, behind = belief.parameters.linearised(belief.mean - step * direction, q)
        second = pairs.whitened((ahead - behind) @ opened) / (2.0 * step * sigma[:, None, None])
        bend[:, k] = -closed @ (follow @ second.reshape(-1, opened.shape[1]))
    mean = 0.5 * np.einsum("ikk->i", bend)
    variance = np.square(belief.root).sum(axis=1) + 0.5 * np.square(bend).sum(axis=(1, 2))
    return np.sqrt(variance + np.square(mean))


def _sides(belief: ChainBelief, pairs: Pairs, sigma: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a root W of the belief in an open part (size, k) and a closed part W_c (size, c), and (J W_c)⁺ (c, 3 n).

    In units of the posterior, the eigenvalues of (J W)ᵀ J W are the shares of the prior's variance that were removed.
    """
    free, triangle = squared(belief.root)
    root = np.zeros((len(belief.mean), len(free)))
    root[free] = triangle
    _, jacobian = belief.parameters.linearised(belief.mean, pairs.q)
    rows = (pairs.whitened(jacobian[:, :, free] @ triangle) / sigma[:, None, None]).reshape(-1, len(free))
    removed_share, vectors = np.linalg.eigh(rows.T @ rows)
    opened, closed = vectors[:, removed_share <= 1.0 - _Settings.open], vectors[:, removed_share > 1.0 - _Settings.open]
    follow = (rows @ closed / removed_share[removed_share > 1.0 - _Settings.open]).T
    return root @ opened, root @ closed, follow


_KIND = "rigid chain, batch, 2"


class RigidLearner(Model):
    """Batch learner of a rigid chain around a nominal one, whose tolerances are the prior.

    The result depends on the pairs only, not on their order or grouping. The fit runs on first use after `learn`
    (7 joints: 10 ms at 30 pairs, 0.1 s at 2,200). Outliers are left out.

    Args:
        nominal: the nominal chain, or one found by `find_chain`.
        tolerances: standard deviations of the real chain about it.
        prior: Gaussian prior, if more than the tolerances is known; it refers to the same nominal chain. Use it to
            continue with another tool: `learner.belief.with_other_tool(0.2)`.

    Raises:
        ShapeError: the prior belongs to another chain.
        DegenerateDataError: `scatter` and `report` before the first pair.

    Example:
        >>> import numpy as np
        >>> from kbmaps import ChainTolerances, RigidChain, RigidLearner
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> learner = RigidLearner(arm.with_tool([0.0, 0.0, 0.1]), ChainTolerances(tool=0.1))
        >>> q = np.random.default_rng(0).uniform(-1, 1, (5, 2))
        >>> learner.learn(q, arm.positions(q))
        >>> learner.report().tool_shift.value.round(6) + 0.0
        array([ 0. ,  0. , -0.1])
    """

    def __init__(self, nominal: RigidChain, tolerances: ChainTolerances, prior: ChainBelief | None = None) -> None:
        self._parameters = ChainParameters(nominal)
        self._tolerances = tolerances
        self._prior_given = prior is not None
        if prior is None:
            self._prior = ChainBelief.from_tolerances(self._parameters, tolerances)
        else:
            self._prior = ChainBelief(self._parameters, prior.mean, prior.root)
        self._place = PlacedStart(self._parameters, tolerances)
        self._q, self._x = np.empty((0, nominal.joints)), np.empty((0, 3))
        self._sigma, self._shape, self._common = np.empty(0), np.empty((0, 3, 3)), np.empty((0, 3, 0))
        self._fit: RigidFit | None = None
        self._widest = 0.0

    @property
    def joints(self) -> int:
        return self.nominal.joints

    @property
    def pairs(self) -> int:
        return len(self._q)

    @property
    def nominal(self) -> RigidChain:
        """Chain that learning started from."""
        return self._parameters.reference

    @property
    def chain(self) -> RigidChain:
        """Most probable chain."""
        return self.belief.chain

    @property
    def tolerances(self) -> ChainTolerances:
        """Standard deviations of the real chain about the nominal one."""
        return self._tolerances

    @property
    def prior(self) -> ChainBelief:
        """Gaussian over the parameters before the first pair."""
        return self._prior

    @property
    def belief(self) -> ChainBelief:
        """Posterior of the chain; the prior without pairs."""
        fit = self._fitted()
        return self._prior if fit is None else fit.belief

    @property
    def change(self) -> FloatArray:
        """Most probable parameters (size,) as in `ChainParameters` (read-only)."""
        return self.belief.mean

    @property
    def covariance(self) -> FloatArray:
        """Posterior covariance (size, size) of the parameters [rad², m²]; the prior's without pairs (read-only)."""
        return frozen(self.belief.covariance)

    @property
    def inliers(self) -> BoolArray:
        """True for each pair (n,), in the order of learning, that is not an outlier."""
        fit = self._fitted()
        return np.zeros(0, dtype=np.bool_) if fit is None else fit.inliers.copy()

    @property
    def unknowns(self) -> FloatArray:
        """Most probable values (k,) of the unknowns that all pairs share, in their sigmas."""
        fit = self._fitted()
        return np.zeros(self._common.shape[2]) if fit is None else fit.common

    @property
    def scatter(self) -> Scatter:
        """Scatter of the pairs about the chain."""
        fit = self._fitted()
        if fit is None:
            raise DegenerateDataError("nothing lies around the chain before the first pair was learnt")
        return self._scatter(fit)

    @property
    def least_sure(self) -> FloatArray:
        """Configuration (1, d) of the inlier with the largest predicted uncertainty; (0, d) without pairs."""
        fit = self._fitted()
        q = self._q if fit is None else self._q[fit.inliers]
        _, variance = self.belief.predict_with_variance(q)
        return q[np.argsort(-variance.sum(axis=1))[:1]]

    @property
    def log_evidence(self) -> float:
        """Log marginal likelihood of the inliers (Laplace's approximation); 0 without pairs."""
        fit = self._fitted()
        return 0.0 if fit is None else fit.log_evidence

    def learn(
        self,
        q: ArrayLike,
        x: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        cov: ArrayLike | None = None,
        common: ArrayLike | None = None,
    ) -> None:
        """Learn pairs, as every `Model` does.

        Args:
            q, x, sigma: as soon as one pair comes without its sigma, the noise is estimated for all, and given sigmas
                count relative to their median.
            cov: instead of sigma: covariances [m²], (3, 3) or (n, 3, 3), if directions differ in accuracy: the depth of
                one camera is far less certain than the position across the view.
            common: (n, 3, k) [m], the errors caused by k unknowns shared by all pairs, at 1 sigma of each, such as
                those of a camera's calibration. They are estimated with the chain and are not part of sigma or cov.
                Compute them at predicted positions: measured ones would share their noise with the pairs.

        Raises:
            ShapeError, NonFiniteError, SettingError (a sigma that is not positive, a covariance that is not positive
                definite, or both): nothing has changed.
        """
        if sigma is not None and cov is not None:
            raise SettingError("give sigma or cov, not both")
        angles, positions, sigmas = checked_pairs(q, x, sigma, self.joints)
        shape = np.broadcast_to(np.eye(3), (len(angles), 3, 3))
        if cov is not None:
            sigmas, shape = of_covariances(cov, len(angles))
        shared = np.zeros((len(angles), 3, 0)) if common is None else numbers("common", common)
        if shared.ndim != 3 or shared.shape[:2] != positions.shape:
            raise ShapeError("common", f"({len(angles)}, 3, k)", shared.shape)
        if not np.isfinite(shared).all():
            raise NonFiniteError("common")
        self._q = np.concatenate([self._q, angles])
        self._x = np.concatenate([self._x, positions])
        self._sigma, self._shape = np.concatenate([self._sigma, sigmas]), np.concatenate([self._shape, shape])
        columns = max(self._common.shape[2], shared.shape[2])
        self._common = np.concatenate(
            [np.pad(each, ((0, 0), (0, 0), (0, columns - each.shape[2]))) for each in (self._common, shared)]
        )
        self._fit = None

    def weigh(self, stated: ArrayLike) -> None:
        """Weight each direction of the learnt pairs by its stated covariance, as far as the residuals confirm it.

        The noise is estimated as if none had been given. If every stated covariance is isotropic, nothing changes.

        Args:
            stated: covariances (n, 3, 3) [m²] of the learnt positions; NaN for a pair without one.

        Raises:
            ShapeError: they belong to other pairs.
        """
        covariances = numbers("stated", stated)
        if covariances.shape != (self.pairs, 3, 3):
            raise ShapeError("stated", f"({self.pairs}, 3, 3)", covariances.shape)
        if not is_anisotropic(covariances):
            return
        unweighted = Pairs(self._q, self._x, np.ones(self.pairs), False, None, self._common)
        change, errors = rough_fit(self._prior, unweighted, self._start())
        _, jacobian = self._parameters.linearised(change, self._q)
        readings = jacobian[:, :, self._parameters.zeros][:, :, ~self.nominal.prismatic]
        estimated = error_covariances(errors, covariances, readings)
        self._sigma = np.full(self.pairs, np.nan)
        self._shape = math.sqrt(float(np.trace(estimated, axis1=1, axis2=2).mean()) / 3.0) * inverse_roots(estimated)
        self._take(fit_chain(self._prior, self.data, change, near=True))

    def predict(self, q: ArrayLike) -> FloatArray:
        angles = rows_or_vector("q", q, self.joints)
        return self._parameters.positions(self.belief.mean, angles)

    def jacobian(self, q: ArrayLike) -> FloatArray:
        return self._parameters.jacobian(self.belief.mean, q)

    def estimate(self, q: ArrayLike) -> Estimate:
        """Return positions with their uncertainty; residuals beyond the given noise are added to sigma."""
        angles = rows_or_vector("q", q, self.joints)
        fit = self._fitted()
        x, variance = self.belief.predict_with_variance(np.atleast_2d(angles))
        if fit is None:
            return Estimate(x, np.sqrt(variance), np.zeros(len(x), dtype=np.bool_)).like(angles)
        sigma = claimed_sigma(variance, self.data, fit.noise, fit.freedom)
        return Estimate(x, sigma, near_data(variance, self._widest)).like(angles)

    def report(self) -> ChainReport:
        """Return hand-eye, tool centre point and joint offsets with 95 % intervals."""
        fit = self._fitted()
        if fit is None:
            raise DegenerateDataError("there is nothing to report before the first pair was learnt")
        pairs, scatter = self.data, self._scatter(fit)
        widening = 1.0 if pairs.known else student(fit.freedom)
        before, after = (np.sqrt(np.square(belief.root).sum(axis=1)) for belief in (self._prior, fit.belief))
        lever = np.where(self._parameters.turning, self._parameters.reach, 1.0)
        return chain_report(
            self._parameters,
            fit.belief.mean,
            widening * self._deviations(fit, pairs),
            (after > _Settings.min_remaining_share * before) & (before * lever > (scatter.noise * scatter.misfit)),
            scatter=scatter,
            widening=widening,
            outliers=int((~fit.inliers).sum()),
            determined=fit.rank,
        )

    def _scatter(self, fit: RigidFit) -> Scatter:
        pairs = self.data
        unit = math.sqrt(float(np.square(pairs.unit).mean()))
        noise, misfit = (unit, fit.noise) if pairs.known else (unit * fit.noise, 1.0)
        return Scatter(noise, misfit, fit.freedom)

    def to_bytes(self) -> bytes:
        arrays = chain_arrays(self.nominal) | self.stored()
        if self._common.any():
            arrays["common"] = self._common
        if self._prior_given:
            arrays |= {"prior_mean": self._prior.mean, "prior_root": self._prior.root}
        return pack(_KIND, {"tolerances": describe_tolerances(self._tolerances)}, arrays)

    def stored(self) -> dict[str, FloatArray]:
        """Return the arrays that `restore` takes."""
        arrays = {"q": self._q, "x": self._x, "sigma": self._sigma}
        return arrays | {"shape": self._shape} if self._shaped else arrays

    def restore(self, arrays: Mapping[str, FloatArray]) -> None:
        """Resume with stored pairs."""
        self._q, self._x, self._sigma = stored_pairs(arrays, self.joints)
        shape = arrays.get("shape", np.broadcast_to(np.eye(3), (self.pairs, 3, 3)))
        if shape.shape != (self.pairs, 3, 3) or not np.isfinite(shape).all():
            raise ModelFormatError(f"no shapes of {self.pairs} pairs' errors: {shape.shape}")
        self._shape, self._common = shape, np.empty((self.pairs, 3, 0))

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        fields, arrays = unpack(data, _KIND)
        with restoring("a rigid learner"):
            tolerances = parse_tolerances(named(fields, "the fields", ("tolerances",))["tolerances"])
            complete(arrays, (*CHAIN, "q", "x", "sigma"), ("prior_mean", "prior_root"), ("shape",), ("common",))
            chain = chain_from_arrays(arrays)
            prior = None
            if "prior_mean" in arrays:
                prior = ChainBelief(ChainParameters(chain), arrays["prior_mean"], arrays["prior_root"])
            learner = cls(chain, tolerances, prior)
            learner.restore(arrays)
            common = arrays.get("common", np.empty((learner.pairs, 3, 0)))
            if common.ndim != 3 or common.shape[:2] != learner._x.shape or not np.isfinite(common).all():
                raise ModelFormatError(f"no common errors of {learner.pairs} pairs: {common.shape}")
            learner._common = common
        return learner

    @property
    def data(self) -> Pairs:
        """Learnt pairs, with their weights."""
        return with_units(self._q, self._x, self._sigma, self._shape if self._shaped else None, self._common)

    @property
    def _shaped(self) -> bool:
        """True if some errors are anisotropic."""
        return bool((self._shape != np.eye(3)).any())

    def _fitted(self) -> RigidFit | None:
        if self._fit is None and self.pairs:
            self._take(fit_chain(self._prior, self.data, self._start()))
        return self._fit

    def _take(self, fit: RigidFit) -> None:
        _, variance = fit.belief.predict_with_variance(self._q[fit.inliers])
        self._fit, self._widest = fit, widest(variance)

    def _deviations(self, fit: RigidFit, pairs: Pairs) -> FloatArray:
        inlier_rows = np.flatnonzero(fit.inliers)
        sample = inlier_rows[:: max(len(inlier_rows) // _Settings.max_followed_pairs, 1)]
        sigma = fit.noise * pairs.unit[sample] * math.sqrt(len(sample) / max(len(inlier_rows), 1))
        return deviations(fit.belief, pairs.chosen(np.isin(np.arange(len(pairs)), sample)), sigma)

    def _start(self) -> FloatArray:
        return self._prior.mean if self._prior_given else self._place.change(self._q, self._x)
