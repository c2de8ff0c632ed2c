"""Batch learner of a nearly rigid arm: the chain and its deviations, from all pairs at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, rows_or_vector
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import (
    CHAIN,
    ChainTolerances,
    chain_arrays,
    chain_from_arrays,
    describe_tolerances,
    parse_tolerances,
)
from kbmaps.chains.rigid_learner import RigidLearner
from kbmaps.model import Estimate, Model, near_data, widest
from kbmaps.packed import complete, named, pack, restoring, unpack
from kbmaps.residual.features import ResidualScaling
from kbmaps.residual.fit import ResidualFit, fit_residual
from kbmaps.residual.model import ResidualModel
from kbmaps.robust import claimed_sigma

_KIND = "rigid chain with residual, batch, 2"
_LEAST_FREEDOM = 10.0


class ResidualLearner(Model):
    """Learner of a rigid chain around a nominal one, and of smooth deviations from it as far as the pairs support them.

    Deviations come in groups: eccentric encoders, gear gains, compliant joints, a distorting camera, and smooth
    functions of one to three joints. The chain's tolerances and each group's variance are the prior; the variances are
    those that make the pairs most probable. The prediction averages over the sets of groups that are about as probable
    as the best. If the pairs support no group, it equals `RigidLearner` to a fraction of its sigma. If no set with a
    group comes near in probability, as without noise, it is equal to the last bit.

    Args:
        nominal: the nominal chain, or one found by `find_chain`.
        tolerances: standard deviations of the real chain about it.
        prior: Gaussian prior of the same chain, or of its deviations too, if more than the tolerances is known. Use it
            to continue with another tool: `learner.model.with_other_tool(0.2)`.

    Raises:
        ShapeError: the prior belongs to another chain.
    """

    def __init__(
        self, nominal: RigidChain, tolerances: ChainTolerances, prior: ChainBelief | ResidualModel | None = None
    ) -> None:
        self._prior = prior if isinstance(prior, ResidualModel) else None
        self._belief = None if isinstance(prior, ResidualModel) else prior
        belief = prior.belief if isinstance(prior, ResidualModel) else prior
        self._rigid = RigidLearner(nominal, tolerances, belief)
        self._model: ResidualModel | None = None
        self._fit: ResidualFit | None = None
        self._widest = 0.0

    @property
    def joints(self) -> int:
        return self._rigid.joints

    @property
    def pairs(self) -> int:
        return self._rigid.pairs

    @property
    def rigid(self) -> RigidLearner:
        """Best rigid chain for the same pairs; its report has hand-eye, tool centre point and joint offsets."""
        return self._rigid

    @property
    def model(self) -> ResidualModel:
        """Snapshot of the learnt model; later learning does not change it."""
        self._fitted()
        return self._model or self._prior or ResidualModel.of_belief(self._rigid.belief)

    @property
    def chain(self) -> RigidChain:
        """Rigid part of the model."""
        return self.model.chain

    @property
    def deviations(self) -> dict[str, float]:
        """Motion of the learnt positions (RMS) [m] by each group of deviations that the pairs support.

        Groups of the prior count as supported; groups that are only in the average, not in the best set, do not.
        """
        fit = self._fitted()
        if fit is None:
            return {}
        return {
            group: effect for group, effect in self.model.effects(self._rigid.data.q).items() if group in fit.groups
        }

    @property
    def inliers(self) -> BoolArray:
        """True for each pair (n,), in the order of learning, that is not an outlier."""
        fit = self._fitted()
        return self._rigid.inliers if fit is None else fit.inliers.copy()

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        self._rigid.learn(q, x, sigma)
        self._model = self._fit = None

    def weigh(self, stated: ArrayLike) -> None:
        """Weight each direction of the learnt pairs by its stated covariance, like `RigidLearner.weigh`."""
        self._rigid.weigh(stated)
        self._model = self._fit = None

    def predict(self, q: ArrayLike) -> FloatArray:
        return self._rigid.predict(q) if self._is_rigid else self.model.predict(q)

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) for q (n, d), to about 1e-12."""
        return self._rigid.jacobian(q) if self._is_rigid else self.model.jacobian(q)

    def estimate(self, q: ArrayLike) -> Estimate:
        """Return positions with their uncertainty; residuals beyond the given noise are added to sigma."""
        if self._is_rigid:
            return self._rigid.estimate(q)
        angles, fit = rows_or_vector("q", q, self.joints), self._fitted()
        x, variance = self.model.predict_with_variance(np.atleast_2d(angles))
        if fit is None:
            return Estimate(x, np.sqrt(variance), np.zeros(len(x), dtype=np.bool_)).like(angles)
        sigma = claimed_sigma(variance, self._rigid.data, fit.noise, fit.freedom)
        return Estimate(x, sigma, near_data(variance, self._widest)).like(angles)

    def to_bytes(self) -> bytes:
        arrays = chain_arrays(self._rigid.nominal) | self._rigid.stored()
        prior, belief = self._prior, self._belief
        known = {"model": prior.to_bytes().hex()} if prior else belief and {"belief": belief.to_bytes().hex()}
        return pack(_KIND, {"tolerances": describe_tolerances(self._rigid.tolerances), "prior": known}, arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        fields, arrays = unpack(data, _KIND)
        with restoring("a rigid chain with residual"):
            named(fields, "the fields", ("tolerances", "prior"))
            complete(arrays, (*CHAIN, "q", "x", "sigma"), ("shape",))
            nominal, tolerances = chain_from_arrays(arrays), parse_tolerances(fields["tolerances"])
            learner = cls(nominal, tolerances, _stored_prior(fields["prior"]))
            learner._rigid.restore(arrays)
        return learner

    @property
    def _is_rigid(self) -> bool:
        """True if no deviation from the rigid chain was found, by this learner or in its prior."""
        return self._fitted() is None and not self.model.weights

    def _fitted(self) -> ResidualFit | None:
        """Return the fit; None without pairs, or if they support only the rigid chain."""
        if self._model is None and self.pairs:
            pairs = self._rigid.data
            before = self._prior
            if before is None or not before.weights:
                load = None if before is None else before.features.scaling.load
                scaling = replace(ResidualScaling.of(pairs.q, pairs.x), load=load)
                before = ResidualModel.of_belief(self._rigid.prior, scaling, 0.0 if before is None else before.noise)
            # A noise that was not given must be visible in the rigid chain's residuals; otherwise anything explains
            # them.
            if pairs.known or before.weights or before.noise > 0.0 or self._rigid.scatter.freedom >= _LEAST_FREEDOM:
                self._fit = fit_residual(before, pairs, self._rigid.change)
            self._model = self._rigid_model(before) if self._fit is None else self._fit.model
            if self._fit is not None:
                _, variance = self._model.predict_with_variance(pairs.q[self._fit.inliers])
                self._widest = widest(variance)
        return self._fit

    def _rigid_model(self, before: ResidualModel) -> ResidualModel:
        scatter = self._rigid.scatter
        noise = scatter.noise * scatter.misfit if scatter.freedom >= _LEAST_FREEDOM else before.noise
        belief = self._rigid.belief
        return ResidualModel(before.features, belief.mean, {}, belief.root, noise)


def _stored_prior(value: Any) -> ChainBelief | ResidualModel | None:
    """Return the prior among the fields of stored bytes. Raises ModelFormatError, TypeError, ValueError."""
    if value is None:
        return None
    if isinstance(value, dict) and "belief" in value:
        return ChainBelief.from_bytes(bytes.fromhex(named(cast(Any, value), "the prior", ("belief",))["belief"]))
    return ResidualModel.from_bytes(bytes.fromhex(named(value, "the prior", ("model",))["model"]))
