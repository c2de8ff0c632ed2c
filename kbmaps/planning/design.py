"""Optimal poses to measure next, by the reduction of a posterior's uncertainty over a region."""

from __future__ import annotations

import math
from typing import Protocol, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]
from scipy.special import gammaln  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import FloatArray, require_positive, rows, vector
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import ChainParameters
from kbmaps.chains.rigid_learner import RigidLearner
from kbmaps.chains.rigid_recursive import RecursiveRigidLearner
from kbmaps.errors import DegenerateDataError, SettingError, ShapeError
from kbmaps.robust import RobustSettings


class Posterior(Protocol):
    """Gaussian posterior of a model that is linear, or linearised, in its parameters."""

    @property
    def joints(self) -> int:
        """Number of joints d."""
        ...

    @property
    def noise(self) -> float:
        """Noise of each coordinate of a further pair, 1-sigma [m], model discrepancy included."""
        ...

    @property
    def floor(self) -> float:
        """1-sigma of the error of a coordinate that remains with any number of pairs [m]; 0 if the model fits."""
        ...

    def roots(self, q: ArrayLike) -> FloatArray:
        """Return matrices R (n, 3, p) [m] at q (n, d): R_i R_jᵀ is the covariance of the positions at q_i and q_j."""
        ...


class ChainPosterior:
    """Posterior of a rigid chain, linearised at the most probable chain, or at its learner's linearisation point.

    Args:
        nominal: the chain that the parameters change.
        change: linearisation point (size,) as in `ChainParameters`.
        covariance: covariance of the change (size, size) [rad², m²].
        noise: 1-sigma of a coordinate of a further pair [m].
        floor: 1-sigma of a coordinate that no rigid chain explains [m].

    Raises:
        ShapeError: change or covariance are of another size.
        SettingError: noise is not positive, or floor is negative.
    """

    def __init__(
        self, nominal: RigidChain, change: FloatArray, covariance: FloatArray, *, noise: float, floor: float = 0.0
    ) -> None:
        require_positive("noise", noise, unit=" m")
        self._parameters = ChainParameters(nominal)
        size = self._parameters.size
        for name, array, shape in (("change", change, (size,)), ("covariance", covariance, (size, size))):
            if array.shape != shape:
                raise ShapeError(name, str(shape), array.shape)
        self._change = np.array(change)
        self._spread = ChainBelief.from_covariance(self._parameters, change, covariance).root
        if not (floor >= 0.0 and math.isfinite(floor)):
            raise SettingError(f"floor must be finite and at least 0 m, got {floor!r}")
        self.noise, self.floor = noise, floor

    @classmethod
    def of(cls, learner: RigidLearner | RecursiveRigidLearner, *, noise: float | None = None) -> ChainPosterior:
        """Return the posterior of a learner. Its floor is 0 unless the residuals exceed the pairs' given noise.

        Args:
            learner: the learner, which may continue to learn.
            noise: 1-sigma of a coordinate of further pairs [m]; None for that of the pairs so far. A recursive learner
                knows only the noise of pairs without their own sigma.

        Raises:
            DegenerateDataError: no noise was given, and the learner has no pairs to estimate it.
            SettingError: noise is not positive.
        """
        floor = 0.0
        if isinstance(learner, RigidLearner) and learner.pairs:
            scatter = learner.scatter
            told = scatter.noise if noise is None else noise
            floor = scatter.noise * math.sqrt(max(scatter.misfit**2 - 1.0, 0.0))
            found = math.hypot(told, floor)
        elif noise is not None:
            found = noise
        elif isinstance(learner, RecursiveRigidLearner):
            found = learner.noise
        else:
            raise DegenerateDataError("without pairs there is no noise to go by; give the noise of further pairs")
        change = learner.origin if isinstance(learner, RecursiveRigidLearner) else learner.change
        return cls(learner.nominal, change, learner.covariance, noise=found, floor=floor)

    @classmethod
    def of_belief(cls, belief: ChainBelief, *, noise: float, floor: float = 0.0) -> ChainPosterior:
        """Return the posterior in a belief about a chain.

        Args:
            belief: Gaussian over the parameters of the chain.
            noise: 1-sigma of a coordinate of a further pair [m].
            floor: 1-sigma of a coordinate that no rigid chain explains [m].

        Raises:
            SettingError: noise is not positive, or floor is negative.
        """
        return cls(belief.parameters.reference, belief.mean, belief.covariance, noise=noise, floor=floor)

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return self._parameters.reference.joints

    def roots(self, q: ArrayLike) -> FloatArray:
        """Return matrices R (n, 3, p) [m] at q (n, d): R_i R_jᵀ is the covariance of the positions at q_i and q_j."""
        _, jacobian = self._parameters.linearised(self._change, rows("q", q, self.joints))
        return jacobian @ self._spread


_EYE = np.eye(3)


class _Settings:
    exchange_values = 9  # values tried per joint when a chosen pose is improved within its limits
    # Rounds in which each pose of a plan is improved in the presence of the others; a third gains 2 % at most.
    plan_rounds = 2


class ExperimentDesign:
    """Uncertainty over a region after adding pairs whose measurement is not known yet.

    The uncertainty of a model linear in its parameters depends only on the poses, not on the measurements (Fedorov
    1972), so it can be predicted. Poses are given by their `roots`, as in `Posterior.roots`.

    Args:
        posterior: the current posterior.
        region: poses (t, d) at which the model is to be accurate.

    Raises:
        SettingError: the region is empty.
    """

    def __init__(self, posterior: Posterior, region: ArrayLike) -> None:
        poses = rows("region", region, posterior.joints)
        if not len(poses):
            raise SettingError("the region must hold at least one pose")
        self._noise_square, self._floor_square = posterior.noise**2, posterior.floor**2
        self._region = posterior.roots(poses)
        self.begin_with(self._region[:0])

    @property
    def error(self) -> float:
        """Expected mean distance [m] between prediction and truth over the region."""
        return self._mean_error(self._left)

    @property
    def least_error(self) -> float:
        """Mean distance [m] that remains with any number of pairs: the model's discrepancy."""
        return float(mean_distances(self._floor_square * _EYE[None])[0])

    def gains(self, roots: FloatArray) -> FloatArray:
        """Return the reduction (n,) [m] of the RMS errors over the region by one pair at each of `roots` (n, 3, p).

        To first order in the variances, which is a lower bound: a square root lies below its tangents.
        """
        seen = self._reduced(roots)
        by_outcome = seen @ self._moment @ seen.swapaxes(1, 2)
        outcome = seen @ seen.swapaxes(1, 2) + self._noise_square * _EYE
        return cast(FloatArray, np.einsum("nii->n", np.linalg.solve(outcome, by_outcome)))

    def add(self, roots: FloatArray) -> None:
        """Count pairs at `roots` (n, 3, p) as measured."""
        self._factor = self._with(roots)
        self._left = self._reduced(self._region)
        variances: FloatArray = np.einsum("tip,tip->t", self._left, self._left) + 3.0 * self._floor_square
        weights = 0.5 / np.sqrt(np.maximum(variances, RobustSettings.variance_floor)) / len(variances)
        flat = (self._left * np.sqrt(weights)[:, None, None]).reshape(-1, self._left.shape[2])
        self._moment = flat.T @ flat

    def begin_with(self, roots: FloatArray) -> None:
        """Count pairs at `roots` (n, 3, p) as measured, and no others."""
        # In units of the posterior's own root the current covariance is the identity.
        self._factor = np.eye(self._region.shape[2])
        self.add(roots)

    def error_after(self, roots: FloatArray) -> float:
        """Return `error` [m] after further pairs at `roots` (n, 3, p)."""
        return self._mean_error(_under(self._with(roots), self._region))

    def _with(self, roots: FloatArray) -> FloatArray:
        """Return L (p, p), lower triangular, with L Lᵀ the information including pairs at `roots` (n, 3, p).

        The information itself is not summed: where pairs add 1e8 times the prior information, the prior would be lost.
        """
        stacked = np.concatenate([self._factor.T, roots.reshape(-1, roots.shape[2]) / math.sqrt(self._noise_square)])
        return cast(FloatArray, np.linalg.qr(stacked, mode="r")).T

    def _reduced(self, roots: FloatArray) -> FloatArray:
        return _under(self._factor, roots)

    def _mean_error(self, left: FloatArray) -> float:
        covariances = left @ left.swapaxes(1, 2) + self._floor_square * _EYE
        return float(mean_distances(covariances).mean())


class _Exchange:
    """Improver of a pose within limits, one joint at a time."""

    def __init__(self, design: ExperimentDesign, posterior: Posterior, lower: ArrayLike, upper: ArrayLike) -> None:
        self._design, self._posterior = design, posterior
        low, high = vector("lower limits", lower, posterior.joints), vector("upper limits", upper, posterior.joints)
        self._values = np.linspace(low, high, _Settings.exchange_values)

    def improved(self, pose: FloatArray) -> FloatArray:
        """Return the pose (d,) after one round in which each joint moves to the best of a few values, or stays."""
        best = pose
        for joint in range(len(pose)):
            tried = np.tile(best, (_Settings.exchange_values + 1, 1))
            tried[:-1, joint] = self._values[:, joint]
            best = tried[int(self._design.gains(self._posterior.roots(tried)).argmax())]
        return best


def next_pose(
    posterior: Posterior, region: ArrayLike, candidates: ArrayLike, *, limits: tuple[ArrayLike, ArrayLike] | None = None
) -> FloatArray:
    """Return the pose (d,) among candidates (n, d) whose pair lowers the error over the region (t, d) most.

    Args:
        posterior: the current posterior.
        region: poses (t, d) at which the model is to be accurate.
        candidates: poses (n, d) to choose from.
        limits: lower and upper joint limits (d,) each; if given, the best candidate is improved within them, one joint
            at a time (coordinate exchange, Meyer and Nachtsheim 1995).

    Raises:
        SettingError: there are no candidates or no region.
    """
    return next_poses(posterior, region, candidates, 1, limits=limits)[0]


def next_poses(
    posterior: Posterior,
    region: ArrayLike,
    candidates: ArrayLike,
    count: int,
    *,
    limits: tuple[ArrayLike, ArrayLike] | None = None,
) -> FloatArray:
    """Return poses (count, d) to measure together before the model is updated.

    Each is the best given those before it, and no candidate is taken twice. With `limits`, as in `next_pose`, each is
    then improved in the presence of all others: a joint plan for many pairs is better than repeating `next_pose`.

    Raises:
        SettingError: count is below 1, or there are fewer candidates.
    """
    poses = rows("candidates", candidates, posterior.joints)
    if not 1 <= count <= len(poses):
        raise SettingError(f"count must be from 1 to the number of candidates, {len(poses)}; got {count}")
    design, roots = ExperimentDesign(posterior, region), posterior.roots(poses)
    exchange = None if limits is None else _Exchange(design, posterior, *limits)
    left, chosen = np.arange(len(poses)), np.empty((count, posterior.joints))
    for k in range(count):
        best = int(design.gains(roots[left]).argmax())
        chosen[k] = poses[left[best]]
        if exchange is not None:
            chosen[k] = exchange.improved(chosen[k])
        left = np.delete(left, best)
        design.add(posterior.roots(chosen[k : k + 1]))
    if exchange is not None and count > 1:
        for k in list(range(count)) * _Settings.plan_rounds:
            design.begin_with(posterior.roots(np.delete(chosen, k, axis=0)))
            chosen[k] = exchange.improved(chosen[k])
    return chosen


def mean_distances(covariances: FloatArray) -> FloatArray:
    """Return the mean length (n,) of Gaussian vectors with covariances (n, 3, 3).

    The squared length is matched to the first two moments of a Gamma distribution (Satterthwaite 1946), whose mean
    square root is known. Exact for one direction and for three equal ones; in between within 2.5 %.
    """
    traces = np.einsum("nii->n", covariances)
    squares = np.einsum("nij,nij->n", covariances, covariances)
    shape = np.square(traces) / (2.0 * np.maximum(squares, RobustSettings.variance_floor**2))
    shape = np.maximum(shape, 0.5)
    ratio = np.exp(gammaln(shape + 0.5) - gammaln(shape))
    return cast(FloatArray, np.sqrt(traces / shape) * ratio)


def _under(factor: FloatArray, roots: FloatArray) -> FloatArray:
    """Return R L⁻ᵀ (n, 3, p), the roots under the information L Lᵀ."""
    flat = roots.reshape(-1, roots.shape[2])
    reduced = cast(FloatArray, solve_triangular(factor, flat.T, lower=True, check_finite=False))
    return reduced.T.reshape(roots.shape)
