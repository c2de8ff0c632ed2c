"""Posterior of a model's parameters, as far as positions show it."""

from __future__ import annotations

import math
from copy import copy
from typing import Protocol, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree  # pyright: ignore[reportMissingTypeStubs]

from kbmaps.arrays import FloatArray, IntArray, rows
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import ChainParameters
from kbmaps.chains.rigid_learner import RigidLearner
from kbmaps.chains.rigid_recursive import RecursiveRigidLearner
from kbmaps.errors import DegenerateDataError, SettingError, ShapeError


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
        """Error of a coordinate that remains with any number of pairs, 1-sigma [m]; 0 where the model fits."""
        ...

    def roots(self, q: ArrayLike) -> FloatArray:
        """Return matrices R (n, 3, p) [m] at q (n, d): R_i R_jᵀ is the covariance of the positions at q_i and q_j."""
        ...


class ChainPosterior:
    """Posterior of a rigid chain, linearised at the most probable chain, or at its learner's linearisation point.

    Args:
        nominal: the chain that the parameters change.
        change: linearisation point (size,) as in `ChainParameters`.
        covariance: of the change (size, size) [rad², m²].
        noise: 1-sigma of a coordinate of a further pair [m].
        floor: 1-sigma of a coordinate that no rigid chain explains [m].

    Raises:
        ShapeError: change or covariance are of another size.
        SettingError: noise is not positive, or floor is negative.
    """

    def __init__(
        self, nominal: RigidChain, change: FloatArray, covariance: FloatArray, *, noise: float, floor: float = 0.0
    ) -> None:
        if not (noise > 0.0 and math.isfinite(noise)):
            raise SettingError(f"noise must be finite and greater than 0 m, got {noise!r}")
        self._parameters = ChainParameters(nominal)
        size = self._parameters.size
        for name, array, shape in (("change", change, (size,)), ("covariance", covariance, (size, size))):
            if array.shape != shape:
                raise ShapeError(name, str(shape), array.shape)
        self._change = np.array(change)
        self._spread = ChainBelief.from_covariance(self._parameters, change, covariance).root
        self.noise, self.floor = noise, _checked_floor(floor)

    @classmethod
    def of(cls, learner: RigidLearner | RecursiveRigidLearner, *, noise: float | None = None) -> ChainPosterior:
        """Return the posterior of a learner. Its floor is 0 unless the pairs' given noise does not explain them.

        Args:
            learner: the learner, which may go on learning.
            noise: 1-sigma of a coordinate of further pairs [m]; None takes that of the pairs so far. A recursive
                learner knows only the noise of pairs that came without their sigma.

        Raises:
            DegenerateDataError: no noise was given and the learner has none, being without pairs.
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

    def with_floor(self, floor: float) -> ChainPosterior:
        """Return the same with another floor [m], e.g. from `systematic_error` where the noise was not given.

        Raises:
            SettingError: floor is negative.
        """
        changed = copy(self)
        changed.floor = _checked_floor(floor)
        return changed

    def roots(self, q: ArrayLike) -> FloatArray:
        """Return matrices R (n, 3, p) [m] at q (n, d): R_i R_jᵀ is the covariance of the positions at q_i and q_j.

        Raises:
            ShapeError, NonFiniteError
        """
        _, jacobian = self._parameters.linearised(self._change, rows("q", q, self.joints))
        return jacobian @ self._spread


def _checked_floor(floor: float) -> float:
    if not (floor >= 0.0 and math.isfinite(floor)):
        raise SettingError(f"floor must be finite and at least 0 m, got {floor!r}")
    return floor


# Minimum number of neighbour couples, and of standard errors that their shared part must exceed.
_LEAST_NEIGHBOURS, _SURE = 10, 2.0


def systematic_error(posterior: Posterior, q: ArrayLike, residuals: ArrayLike) -> float:
    """Return the 1-sigma [m] of the part of a coordinate's residual that neighbouring poses share; 0 if due to chance.

    Noise is independent from pair to pair, while a bending joint or a distorting lens errs alike at poses near each
    other. The mean product of residuals of neighbours is therefore the systematic part, once the fit's own part has
    been removed: it makes the residuals of neighbours i and j share −R_i R_jᵀ. The result is a lower bound, since
    neighbours are not the same pose: the sparser the poses, the more of it counts as noise.

    Args:
        posterior: of the model that has learnt the pairs.
        q: poses (n, d) of the pairs, outliers left out.
        residuals: measured minus predicted positions there (n, 3) [m].

    Raises:
        ShapeError, NonFiniteError
    """
    poses, missed = rows("q", q, posterior.joints), rows("residuals", residuals, 3)
    if len(poses) != len(missed):
        raise ShapeError("residuals", f"({len(poses)}, 3) to go with q", missed.shape)
    if len(poses) < 2:
        return 0.0
    one, other = _neighbours(poses)
    roots = posterior.roots(poses)
    shared = np.einsum("ni,ni->n", missed[one], missed[other])
    shared = shared + np.einsum("nip,nip->n", roots[one], roots[other])
    doubt = float(shared.std()) / math.sqrt(len(shared))
    mean = float(shared.mean())
    if len(shared) < _LEAST_NEIGHBOURS or mean <= _SURE * doubt:
        return 0.0
    return math.sqrt(mean / 3.0)


def _neighbours(poses: FloatArray) -> tuple[IntArray, IntArray]:
    """Return each pose with its nearest one, each such couple once, distances in standard deviations of the joints."""
    std = poses.std(axis=0)
    scaled = poses / np.where(std > 0.0, std, 1.0)
    nearest = cast(IntArray, KDTree(scaled).query(scaled, 2)[1])  # pyright: ignore[reportUnknownMemberType]
    # Where poses are equal, a pose may not be found first among its own neighbours.
    own = np.arange(len(poses))
    found = np.where(nearest[:, 0] == own, nearest[:, 1], nearest[:, 0])
    couples = np.unique(np.sort(np.stack([own, found], axis=1), axis=1), axis=0)
    return couples[:, 0], couples[:, 1]
