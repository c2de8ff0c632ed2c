"""Predictive uncertainty of each model: in-sample, extrapolated, and calibrated on prequential errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.model_bank import INSTANT, PRIOR, RESIDUAL, RIGID, SOLVED, TRUSTED
from bodyschema.learning.variance_terms import (
    ChainTerm,
    DepartureTerm,
    GrowingSupport,
    Predict,
    QueryPoints,
    VarianceTerm,
)
from kbmaps import ChainBelief, JointBasis, PrequentialComparison, Recent, ResidualModel, SupportSet
from kbmaps.contest import ContestSettings
from kbmaps.robust import RobustSettings


class UncertaintySettings:
    discount = 0.98  # Weight of the error one pair back: the memory is about 50 pairs long
    # Below this number of pairs the prior expectation, or the discrepancy with the last tool, counts too.
    warm_pairs = 10.0


class ErrorMemory(msgspec.Struct):
    """Discounted sums over one model's recent prediction errors."""

    expected_m: float  # RMS distance expected before there were errors [m]
    discount: float = UncertaintySettings.discount  # weight of the error one pair back
    weight: float = 0.0  # effective number of errors
    square: tuple[float, float, float] = (0.0, 0.0, 0.0)  # sums of their squares per axis [m²]
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)  # sums of the measurements' variances per axis [m²]
    ratio: float = 0.0  # sum of their squares over the predicted ones

    def add(self, errors: FloatArray, variances: FloatArray, ratios: FloatArray | float = 1.0) -> None:
        """Add errors, in order.

        Args:
            errors: prediction minus measurement (n, 3) [m].
            variances: variances of the measurements per axis, (n, 3), or (3,) for all [m²].
            ratios: squared errors divided by the predicted squares of prediction and measurement (n,), or one for all.
        """
        count = len(errors)
        kept, faded = self.discount**count, self.discount ** np.arange(count - 1.0, -1.0, -1.0)
        squares = np.square(errors)
        self.weight = kept * self.weight + float(faded.sum())
        self.square = _triple(kept * np.array(self.square) + faded @ squares)
        self.noise = _triple(kept * np.array(self.noise) + faded @ np.broadcast_to(variances, squares.shape))
        self.ratio = kept * self.ratio + float(faded @ np.broadcast_to(ratios, count))

    @property
    def rms_m(self) -> float:
        """RMS distance between prediction and measurement [m], shrunk towards the expected one while errors are few."""
        missing = max(UncertaintySettings.warm_pairs - self.weight, 0.0)
        weight = max(self.weight, UncertaintySettings.warm_pairs)
        return math.sqrt((sum(self.square) + missing * self.expected_m**2) / weight)

    @property
    def sigma(self) -> FloatArray:
        """Uncertainty of the prediction against the truth, 1-sigma per axis (3,) [m]; noise is subtracted."""
        missing = max(UncertaintySettings.warm_pairs - self.weight, 0.0)
        weight = max(self.weight, UncertaintySettings.warm_pairs)
        square = (np.array(self.square) + missing * self.expected_m**2 / 3.0) / weight
        noise = self.noise_variance
        return np.sqrt(np.maximum(square - noise, noise * math.sqrt(2.0 / max(self.weight, 2.0))))

    @property
    def noise_variance(self) -> FloatArray:
        """Mean variance of the measurements per axis (3,) [m²]."""
        return np.array(self.noise) / max(self.weight, 1.0)

    @property
    def surprise(self) -> float:
        """Ratio of the errors to the predicted ones, at least 1."""
        missing = max(UncertaintySettings.warm_pairs - self.weight, 0.0)
        return math.sqrt(max((self.ratio + missing) / max(self.weight, UncertaintySettings.warm_pairs), 1.0))


_SUPPORT, _CONTEST = "support_q", "squares_"


@dataclass(frozen=True)
class PredictiveUncertainty:
    inside: FloatArray  # 1-sigma at the data, per axis (3,) [m]
    layers: tuple[VarianceTerm | ChainTerm | DepartureTerm, ...] = ()  # variance terms that the model's data leave
    surprise: float = 1.0  # ratio of the prediction errors to the predicted ones, at least 1

    def variance(self, q: FloatArray) -> FloatArray:
        """Return the variance per axis of predictions at q (n, d) [rad], shape (n, 3) [m²]."""
        return self.variance_there(QueryPoints(q))

    def variance_there(self, where: QueryPoints) -> FloatArray:
        """Return the variance as in `variance`."""
        left_open = sum((layer.variance(where) for layer in self.layers), np.zeros((len(where.q), 3)))
        return self.surprise**2 * (self.inside**2 + left_open)

    def beyond_chain(self, q: FloatArray) -> FloatArray:
        """Return the part that is not uncertainty of the chain's parameters, at q (n, d) [rad], shape (n, 3) [m²]."""
        where = QueryPoints(q)
        open_layers = (
            layer.variance(where) for layer in self.layers if isinstance(layer, VarianceTerm) and layer.sigma > 0.0
        )
        return self.inside**2 + sum(open_layers, np.zeros((len(q), 3)))


class UncertaintyState(msgspec.Struct, kw_only=True):
    """State of the uncertainties, without arrays."""

    errors: dict[str, ErrorMemory]  # prequential errors, by model
    judged: int  # number of compared pairs so far
    trusted: tuple[str, ...]  # the models, the most trusted first
    residuals: ErrorMemory | None  # errors of the instant learner on pairs that it has learnt already; None before any
    # discrepancy of each solution at pairs that it knows, 1-sigma per axis [m]
    misfits: dict[str, tuple[float, float, float]]
    misfits_before: dict[str, tuple[float, float, float]]  # the same with the last tool, 1-sigma per axis [m]
    belief: bytes | None  # posterior of the chain, as bytes; None before a solution was requested
    wide: bytes | None  # the same without the selection of narrower tolerances
    residual: bytes | None  # the chain with residual, as bytes; None before its first solution


class UncertaintyTracker:
    """Tracker of the errors and the data support of all models since the prior was made.

    Args:
        bases: bases of the learnt maps.
        expected_m: expected RMS distance between prior and reality before there are errors [m].

    Attributes:
        belief: posterior of the chain from the pairs with the current tool; None before a solution was requested.
        wide: posterior without the selection of narrower tolerances, to be updated with pairs of another tool.
        residual: posterior of the arm as a chain with residual, with the current tool; None before its first solution.
    """

    def __init__(self, bases: Sequence[JointBasis], expected_m: float) -> None:
        self._bases = bases
        self._misfits_before: dict[str, FloatArray] = {}
        self._trusted = TRUSTED
        self._begin(expected_m)

    def _begin(self, expected_m: float) -> None:
        self._expected_m = expected_m
        self.errors = {name: ErrorMemory(expected_m) for name in (PRIOR, INSTANT)}
        self._contest = PrequentialComparison()
        self._residuals: ErrorMemory | None = None
        self._misfits: dict[str, FloatArray] = {}
        self._support = GrowingSupport(self._bases)
        self._asked: SupportSet | None = None
        self._solved: dict[str, SupportSet | None] = {}
        self._expected: ChainBelief | None = None
        self.belief: ChainBelief | None = None
        self.wide: ChainBelief | None = None
        self.residual: ResidualModel | None = None

    def best(self, present: str) -> str:
        """Return the best model; `present` if there is nothing to compare."""
        return self._contest.best(self._trusted, present)

    def best_map(self, present: str) -> str:
        """Return the best of the models that are KB-Maps; `present` if there is nothing to compare."""
        return self._contest.best([name for name in self._trusted if name != RESIDUAL], present)

    def recent(self, answering: str) -> Recent:
        """Return the models' errors on the last pairs, each of the age of the newest solution."""
        return self._contest.recent(answering)

    @property
    def support(self) -> SupportSet | None:
        """Support of the data with the current tool; None without data."""
        return self._support.view

    @property
    def noise_m(self) -> float:
        """Noise of the measurements: RMS distance from the truth [m], as claimed with them."""
        return float(np.sqrt(self.errors[PRIOR].noise_variance.sum()))

    def change_tool(self, expected_m: float, answered: str = PRIOR) -> None:
        """Reset the models' errors for another tool; `expect` sets the posterior of the arm.

        The solved model that answered with the last tool is trusted first with this one, because the arm is the same.
        """
        if answered in SOLVED:
            self._trusted = (answered, *(name for name in TRUSTED if name != answered))
        self._misfits_before |= self._misfits
        self._begin(expected_m)

    def expect(self, belief: ChainBelief) -> None:
        """Set the prior of the chain before the first pair with the current tool."""
        self._expected = belief

    def fitted(self, belief: ChainBelief) -> None:
        """Set the posterior of the chain from the first pairs, before any solution."""
        self.belief = self.wide = belief

    def untried(self, name: str) -> bool:
        """Return True if this model has a solution that has predicted too few pairs to be compared."""
        return name in self._misfits and not self._contest.compares(name)

    def predicted(
        self,
        where: QueryPoints,
        x: FloatArray,
        predictions: Mapping[str, FloatArray],
        variances: FloatArray,
        delayed: FloatArray | None = None,
    ) -> None:
        """Record pairs, in order, each of which was predicted before it was learnt.

        Args:
            where: their q (n, d) [rad].
            x: measured positions (n, 3) [m].
            predictions: predictions of x (n, 3) [m] by model.
            variances: variances of the measurements (n, 3) [m²].
            delayed: predictions of the instant learner as old as the solutions (n, 3) [m]. On a path, a few pairs make
                a difference, so the models are compared at the same age.
        """
        for name, predicted in predictions.items():
            errors = x - predicted
            claimed = self.of(name, lambda _, predicted=predicted: predicted).variance_there(where) + variances
            self.errors[name].add(errors, variances, np.square(errors).sum(axis=1) / claimed.sum(axis=1))
        compared = dict(predictions) if delayed is None else {**predictions, INSTANT: delayed}
        self._contest.add({name: np.square(x - each).sum(axis=1) for name, each in compared.items()})

    def learnt(self, q: FloatArray) -> None:
        """Record that pairs have been learnt at q (n, d) [rad]."""
        self._support.add(q)

    def replayed(self, errors: FloatArray) -> None:
        """Record errors (n, 3) [m] of the instant learner at pairs that it has learnt before."""
        self._residuals = self._residuals or ErrorMemory(self._expected_m)
        self._residuals.add(errors, self.errors[PRIOR].noise_variance)

    def solution_asked(self) -> None:
        self._asked = self._support.view

    def solution_taken(
        self,
        name: str,
        errors: FloatArray,
        belief: ChainBelief | ResidualModel | None,
        wide: ChainBelief | None = None,
        *,
        neighbours: bool,
        variances: FloatArray | None = None,
    ) -> None:
        """Record a solution that answers for this model from now on.

        Args:
            name: the model.
            errors: its errors (n, 3) [m] at pairs that it has learnt, in order.
            belief: new posterior of the arm; None if unchanged.
            wide: for a chain, its posterior without the selection of narrower tolerances.
            neighbours: True if these pairs follow a path.
            variances: variances of these measurements (n, 3) [m²], NaN if unknown; None for the usual ones.
        """
        self.errors.setdefault(name, ErrorMemory(self._expected_m))
        self._solved[name] = self._asked
        if isinstance(belief, ResidualModel):
            self.residual = belief
        elif belief is not None:
            self.belief, self.wide = belief, wide or belief
        noise = np.broadcast_to(self.errors[PRIOR].noise_variance, errors.shape)
        noise = noise if variances is None else np.where(np.isfinite(variances), variances, noise)
        before = self._misfits_before.get(name, self._misfits_before.get(RIGID, np.zeros(3)))
        scatter = 0.0 if belief is None else belief.noise
        self._misfits[name] = model_discrepancy(errors, noise, before, neighbours=neighbours, scatter=scatter)

    def predicted_late(
        self, name: str, predict: Predict, q: FloatArray, errors: FloatArray, instant: FloatArray, *, anew: bool
    ) -> None:
        """Record the errors of a new solution on the last pairs, none of which it was fitted to.

        Args:
            name: the model.
            predict: its positions (n, 3) [m] at q (n, d) [rad].
            q: configurations (n, d) [rad], in order.
            errors: measured minus predicted (n, 3) [m].
            instant: the same errors of the instant learner at the time of the request. NaN if it had already learnt the
                pair, which would be an unfair advantage.
            anew: True if it knows so much more than the last solution that the latter's errors no longer apply.
        """
        if anew:
            self._contest.forget(name)
            self.errors[name] = ErrorMemory(self._expected_m)
        for each, missed in ((name, errors), (INSTANT, instant)):
            self._contest.add_late(each, np.square(missed).sum(axis=1))
        noise = self.errors[PRIOR].noise_variance
        claimed = self.of(name, predict).variance(q) + noise
        self.errors[name].add(errors, noise, np.square(errors).sum(axis=1) / claimed.sum(axis=1))

    def forget_contest(self) -> None:
        """Drop the comparison, because some pairs do not belong to this tool."""
        self._contest = PrequentialComparison()

    def prior_changed(self, errors: FloatArray) -> None:
        """Record another prior for the same pairs; its errors (n, 3) [m] at them."""
        noise = self.errors[PRIOR].noise_variance
        self.errors[PRIOR] = ErrorMemory(self._expected_m)
        self._contest.forget(PRIOR)
        self.errors[PRIOR].add(errors, noise)

    def of(self, name: str, predict: Predict | None = None) -> PredictiveUncertainty:
        """Return the predictive uncertainty of one model.

        Args:
            name: the model.
            predict: its positions (n, 3) [m] at q (n, d) [rad]; None before the model exists.
        """
        memory = self.errors.get(name, ErrorMemory(self._expected_m))
        belief = self.belief or self._expected
        if belief is None or predict is None:
            return PredictiveUncertainty(memory.sigma)
        none = np.zeros(3)
        if name in SOLVED:
            chain = self.residual if name == RESIDUAL and self.residual is not None else belief
            return PredictiveUncertainty(
                self._misfits.get(name, none), (ChainTerm(chain), self._rest(name)), memory.surprise
            )
        if name == PRIOR:
            # The prior is a chain too, or was learnt with the last tool, so it has such a chain's discrepancy.
            inside = self._misfits.get(RIGID, self._misfits_before.get(RIGID, none))
            departure = DepartureTerm(predict, belief)
        else:
            inside = (memory if self._residuals is None else self._residuals).sigma
            departure = DepartureTerm(predict, belief, self.support)
        return PredictiveUncertainty(inside, (ChainTerm(belief), departure, self._rest(RIGID)), memory.surprise)

    def _rest(self, name: str) -> VarianceTerm:
        """Return the term for the arm's deviation from the chain away from data: as large as at the data."""
        missed = self._misfits.get(RESIDUAL if name == RESIDUAL else RIGID, np.zeros(3))
        return VarianceTerm(self._solved.get(name), float(np.sqrt(np.square(missed).mean())))

    def state(self) -> UncertaintyState:
        """Return everything needed to resume, except `arrays`."""
        return UncertaintyState(
            errors=self.errors,
            judged=self._contest.pairs,
            trusted=self._trusted,
            residuals=self._residuals,
            misfits={name: _triple(missed) for name, missed in self._misfits.items()},
            misfits_before={name: _triple(missed) for name, missed in self._misfits_before.items()},
            belief=None if self.belief is None else self.belief.to_bytes(),
            wide=None if self.wide is None else self.wide.to_bytes(),
            residual=None if self.residual is None else self.residual.to_bytes(),
        )

    def arrays(self) -> dict[str, FloatArray]:
        """Return the configurations (n, d) [rad] that represent all data, and squared errors (k,) [m²] by model."""
        return {_SUPPORT: self._support.configurations} | {
            _CONTEST + name: values.copy() for name, values in self._contest.errors.items()
        }

    def restore(self, state: UncertaintyState, arrays: Mapping[str, FloatArray]) -> None:
        """Resume from a state and its `arrays`."""
        self._support.add(arrays[_SUPPORT])
        self.errors, self._residuals = dict(state.errors), state.residuals
        squares = {name.removeprefix(_CONTEST): v for name, v in arrays.items() if name.startswith(_CONTEST)}
        self._contest = PrequentialComparison(squares, state.judged)
        self._misfits = {name: np.array(missed) for name, missed in state.misfits.items()}
        self._trusted = state.trusted
        self._misfits_before = {name: np.array(missed) for name, missed in state.misfits_before.items()}
        self.belief = None if state.belief is None else ChainBelief.from_bytes(state.belief)
        self.wide = None if state.wide is None else ChainBelief.from_bytes(state.wide)
        self.residual = None if state.residual is None else ResidualModel.from_bytes(state.residual)
        self._asked = self._support.view
        self._solved = dict.fromkeys(self._misfits, self._asked)


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def model_discrepancy(
    errors: FloatArray, noise_variance: FloatArray, before: FloatArray, *, neighbours: bool, scatter: float = 0.0
) -> FloatArray:
    """Return the model discrepancy, 1-sigma per axis (3,) [m], without the measurements' noise; 0 if due to chance.

    On a path, neighbours have the same discrepancy and mostly independent noise: the shared part is the discrepancy,
    independent of the claimed noise. For distant poses, only the claimed noise is available. There the errors are too
    small, because the solution was fitted to these pairs.

    Args:
        errors: measured minus solved (n, 3) [m], in the pairs' order.
        noise_variance: variance of the measurements, (n, 3), or (3,) for all [m²].
        before: discrepancy of the same arm with another tool (3,) [m].
        neighbours: True if the pairs follow a path.
        scatter: 1-sigma of a coordinate around the solution [m], corrected for its degrees of freedom; 0 if unknown.
    """
    noise = np.broadcast_to(noise_variance, errors.shape)
    if scatter > 0.0:
        near = _near(errors, scatter)
        errors, noise = errors[near], noise[near]
    n = len(errors)
    if neighbours and n > 1:
        variance = (errors[1:] * errors[:-1]).mean(axis=0)
        chance = np.square(errors).mean(axis=0) / math.sqrt(n - 1)
    else:
        square = np.square(errors).mean(axis=0)
        taken = max(scatter**2 / max(float(square.mean()), 1e-300), 1.0)
        variance = taken * square - noise.mean(axis=0)
        chance = np.sqrt(2.0 * taken * np.square(noise).mean(axis=0) / n)
    seen = np.where(variance > ContestSettings.clearly * chance, variance, 0.0)
    missing = max(UncertaintySettings.warm_pairs - n, 0.0)
    return np.sqrt((n * seen + missing * np.square(before)) / max(n, UncertaintySettings.warm_pairs))


def _near(errors: FloatArray, scatter: float) -> NDArray[np.bool_]:
    """Return the mask of errors that the fit has not left out; all if these are the minority: then the fit is off."""
    near = np.linalg.norm(errors, axis=1) <= RobustSettings.outlier_sigmas * scatter
    return near if near.mean() > 0.5 else np.ones_like(near)
