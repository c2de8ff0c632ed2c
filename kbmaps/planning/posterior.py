"""Posterior of a model's parameters, as far as positions show it."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, rows
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
        if not (floor >= 0.0 and math.isfinite(floor)):
            raise SettingError(f"floor must be finite and at least 0 m, got {floor!r}")
        self.noise, self.floor = noise, floor

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

    def roots(self, q: ArrayLike) -> FloatArray:
        """Return matrices R (n, 3, p) [m] at q (n, d): R_i R_jᵀ is the covariance of the positions at q_i and q_j."""
        _, jacobian = self._parameters.linearised(self._change, rows("q", q, self.joints))
        return jacobian @ self._spread
