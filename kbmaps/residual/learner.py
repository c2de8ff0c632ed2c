"""Learning an arm that is nearly a rigid chain: the chain, and what it errs by, from all pairs at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, rows_or_vector
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.packed import CHAIN, chain_arrays, chain_from_arrays, describe_tolerances, parse_tolerances
from kbmaps.chains.parameters import ChainTolerances
from kbmaps.chains.rigid_learner import RigidLearner
from kbmaps.model import Estimate, near_data, widest
from kbmaps.packed import complete, named, pack, restoring, unpack
from kbmaps.pairs import checked_pairs, runs, stored_pairs, with_units
from kbmaps.residual.features import ResidualScaling
from kbmaps.residual.fit import ResidualFit, fit_residual
from kbmaps.residual.model import ResidualModel
from kbmaps.robust import claimed_sigma

_KIND = "rigid chain with residual, batch, 2"
_LEAST_FREEDOM = 10.0


class ResidualLearner:
    """A rigid chain around a nominal one, and smooth deviations from it where the pairs ask for them.

    Deviations come in groups: eccentric encoders, gear gains, joints that yield under load, a distorting camera, and
    smooth functions of one to three joints. The chain's tolerances and each group's variance are the prior; the
    variances are those that make the pairs most probable, and what is predicted is the average over those sets of
    groups that are about as probable as the best. Where the pairs speak for no group, that is `RigidLearner` to a
    fraction of its sigma; to the last bit where no set with a group comes near, as without noise.

    Args:
        nominal: the chain as drawn, or as `find_chain` found it.
        tolerances: how far the real one may be from it.
        prior: what is believed before the first pair, where more is known than the tolerances: of the same chain, or of
            its deviations too. So an arm that got another tool is learnt on: `learner.model.with_other_tool(0.2)`.

    Raises:
        ShapeError: the prior is one of another chain.
    """

    def __init__(
        self, nominal: RigidChain, tolerances: ChainTolerances, prior: ChainBelief | ResidualModel | None = None
    ) -> None:
        self._prior = prior if isinstance(prior, ResidualModel) else None
        self._belief = None if isinstance(prior, ResidualModel) else prior
        belief = prior.belief if isinstance(prior, ResidualModel) else prior
        self._rigid = RigidLearner(nominal, tolerances, belief)
        self._q, self._x = np.empty((0, nominal.joints)), np.empty((0, 3))
        self._sigma = np.empty(0)
        self._model: ResidualModel | None = None
        self._fit: ResidualFit | None = None
        self._widest = 0.0

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return self._rigid.joints

    @property
    def pairs(self) -> int:
        """How many pairs have been learnt."""
        return len(self._q)

    @property
    def rigid(self) -> RigidLearner:
        """The rigid chain that explains the same pairs best; its report has hand-eye, tool centre point and zeros."""
        return self._rigid

    @property
    def model(self) -> ResidualModel:
        """What has been learnt, as a value that later learning does not touch."""
        self._fitted()
        return self._model_before if self._model is None else self._model

    @property
    def chain(self) -> RigidChain:
        """The rigid part of the model."""
        return self.model.chain

    @property
    def deviations(self) -> dict[str, float]:
        """By how much each group of deviations that the pairs speak for moves the learnt positions (RMS) [m].

        Groups that the prior has count as spoken for; those that are in the average beside the best set do not.
        """
        fit = self._fitted()
        if fit is None:
            return {}
        return {group: effect for group, effect in self.model.effects(self._q).items() if group in fit.groups}

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
        self._model = self._fit = None

    def predict(self, q: ArrayLike) -> FloatArray:
        """Positions (n, 3) [m] at q (n, d), or (3,) at q (d,).

        Raises:
            ShapeError, NonFiniteError
        """
        return self._rigid.predict(q) if self._is_rigid else self.model.predict(q)

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) for q (n, d), to about 1e-12.

        Raises:
            ShapeError, NonFiniteError
        """
        return self._rigid.jacobian(q) if self._is_rigid else self.model.jacobian(q)

    def estimate(self, q: ArrayLike) -> Estimate:
        """Positions at q (n, d), or (d,), their 1-sigma per axis against the truth, and whether data was there.

        Where the told noise does not explain the residuals, what is left over adds to sigma everywhere.

        Raises:
            ShapeError, NonFiniteError
        """
        if self._is_rigid:
            return self._rigid.estimate(q)
        angles, fit = rows_or_vector("q", q, self.joints), self._fitted()
        x, variance = self.model.predict_with_variance(np.atleast_2d(angles))
        if fit is None:
            return Estimate(x, np.sqrt(variance), np.zeros(len(x), dtype=np.bool_)).like(angles)
        sigma = claimed_sigma(variance, with_units(self._q, self._x, self._sigma), fit.noise, fit.freedom)
        return Estimate(x, sigma, near_data(variance, self._widest)).like(angles)

    def to_bytes(self) -> bytes:
        """The learner with all its pairs; `from_bytes` gives the same predictions to the last bit."""
        arrays = chain_arrays(self._rigid.nominal) | {"q": self._q, "x": self._x, "sigma": self._sigma}
        prior, belief = self._prior, self._belief
        known = {"model": prior.to_bytes().hex()} if prior else belief and {"belief": belief.to_bytes().hex()}
        return pack(_KIND, {"tolerances": describe_tolerances(self._rigid.tolerances), "prior": known}, arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The learner in `data`. Raises ModelFormatError: it is none of this kind, or damaged."""
        fields, arrays = unpack(data, _KIND)
        with restoring("a rigid chain with residual"):
            named(fields, "the fields", ("tolerances", "prior"))
            complete(arrays, (*CHAIN, "q", "x", "sigma"))
            nominal, tolerances = chain_from_arrays(arrays), parse_tolerances(fields["tolerances"])
            learner = cls(nominal, tolerances, _stored_prior(fields["prior"]))
            q, x, sigma = stored_pairs(arrays, learner.joints)
            told = ~np.isnan(sigma)
            for run in runs(told):
                learner.learn(q[run], x[run], sigma[run] if told[run.start] else None)
        return learner

    @property
    def _is_rigid(self) -> bool:
        """Whether the rigid chain is all there is: nothing was found beside it, now or by who made the prior."""
        return self._fitted() is None and not self.model.weights

    @property
    def _model_before(self) -> ResidualModel:
        """What is known without pairs."""
        return self._prior or ResidualModel.of_belief(self._rigid.belief)

    def _fitted(self) -> ResidualFit | None:
        """The fit; None without pairs, and where they speak for nothing but the rigid chain."""
        if self._model is None and self.pairs:
            pairs = with_units(self._q, self._x, self._sigma)
            before = self._prior
            if before is None or not before.weights:
                load = None if before is None else before.features.scaling.load
                scaling = replace(ResidualScaling.of(self._q, self._x), load=load)
                before = ResidualModel.of_belief(self._rigid.prior, scaling, 0.0 if before is None else before.noise)
            # Noise that nobody told must be seen in residuals that the chain alone leaves, or anything explains them.
            if pairs.known or before.weights or before.noise > 0.0 or self._rigid.scatter.freedom >= _LEAST_FREEDOM:
                self._fit = fit_residual(before, pairs, self._rigid.change)
            self._model = self._rigid_model(before) if self._fit is None else self._fit.model
            if self._fit is not None:
                _, variance = self._model.predict_with_variance(self._q[self._fit.inliers])
                self._widest = widest(variance)
        return self._fit

    def _rigid_model(self, before: ResidualModel) -> ResidualModel:
        scatter = self._rigid.scatter
        noise = scatter.noise * scatter.misfit if scatter.freedom >= _LEAST_FREEDOM else before.noise
        belief = self._rigid.belief
        return ResidualModel(before.features, belief.mean, {}, belief.root, noise)


def _stored_prior(value: Any) -> ChainBelief | ResidualModel | None:
    """The prior among the fields of stored bytes. Raises ModelFormatError, TypeError, ValueError."""
    if value is None:
        return None
    if isinstance(value, dict) and "belief" in value:
        return ChainBelief.from_bytes(bytes.fromhex(named(cast(Any, value), "the prior", ("belief",))["belief"]))
    return ResidualModel.from_bytes(bytes.fromhex(named(value, "the prior", ("model",))["model"]))
