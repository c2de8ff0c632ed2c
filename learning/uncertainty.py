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
from kbmaps.prequential import ContestSettings
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
        decay, weights = self.discount**count, self.discount ** np.arange(count - 1.0, -1.0, -1.0)
        squares = np.square(errors)
        self.weight = decay * self.weight + float(weights.sum())
        self.square = _triple(decay * np.array(self.square) + weights @ squares)
        self.noise = _triple(decay * np.array(self.noise) + weights @ np.broadcast_to(variances, squares.shape))
        self.ratio = decay * self.ratio + float(weights @ np.broadcast_to(ratios, count))

    @property
    def rms_m(self) -> float:
        """RMS distance between prediction and measurement [m], shrunk towards the expected one while errors are few."""
        prior_weight = max(UncertaintySettings.warm_pairs - self.weight, 0.0)
        weight = max(self.weight, UncertaintySettings.warm_pairs)
        return math.sqrt((sum(self.square) + prior_weight * self.expected_m**2) / weight)

    @property
    def sigma(self) -> FloatArray:
        """Uncertainty of the prediction against the truth, 1-sigma per axis (3,) [m]; noise is subtracted."""
        prior_weight = max(UncertaintySettings.warm_pairs - self.weight, 0.0)
        weight = max(self.weight, UncertaintySettings.warm_pairs)
        square = (np.array(self.square) + prior_weight * self.expected_m**2 / 3.0) / weight
        noise = self.noise_variance
        return np.sqrt(np.maximum(square - noise, noise * math.sqrt(2.0 / max(self.weight, 2.0))))

    @property
    def noise_variance(self) -> FloatArray:
        """Mean variance of the measurements per axis (3,) [m²]."""
        return np.array(self.noise) / max(self.weight, 1.0)

    @property
    def inflation(self) -> float:
        """Ratio of the errors to the predicted ones, at least 1."""
        prior_weight = max(UncertaintySettings.warm_pairs - self.weight, 0.0)
        return math.sqrt(max((self.ratio + prior_weight) / max(self.weight, UncertaintySettings.warm_pairs), 1.0))


_SUPPORT, _CONTEST = "support_q", "squares_"


@dataclass(frozen=True)
class PredictiveUncertainty:
    in_sample: FloatArray  # 1-sigma at the data, per axis (3,) [m]
    terms: tuple[VarianceTerm | ChainTerm | DepartureTerm, ...] = ()  # variance terms that the model's data leave
    inflation: float = 1.0  # ratio of the prediction errors to the predicted ones, at least 1

    def variance(self, q: FloatArray) -> FloatArray:
        """Return the variance per axis of predictions at q (n, d) [rad], shape (n, 3) [m²]."""
        return self.variance_at(QueryPoints(q))

    def variance_at(self, points: QueryPoints) -> FloatArray:
        """Return the variance as in `variance`."""
        open_variance = sum((term.variance(points) for term in self.terms), np.zeros((len(points.q), 3)))
        return self.inflation**2 * (self.in_sample**2 + open_variance)

    def variance_beyond_chain(self, q: FloatArray) -> FloatArray:
        """Return the part that is not uncertainty of the chain's parameters, at q (n, d) [rad], shape (n, 3) [m²]."""
        points = QueryPoints(q)
        open_variances = (
            term.variance(points) for term in self.terms if isinstance(term, VarianceTerm) and term.sigma > 0.0
        )
        return self.in_sample**2 + sum(open_variances, np.zeros((len(q), 3)))


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
        self._previous_discrepancies: dict[str, FloatArray] = {}
        self._trusted = TRUSTED
        self._begin(expected_m)

    def _begin(self, expected_m: float) -> None:
        self._expected_m = expected_m
        self.errors = {name: ErrorMemory(expected_m) for name in (PRIOR, INSTANT)}
        self._comparison = PrequentialComparison()
        self._residuals: ErrorMemory | None = None
        self._discrepancies: dict[str, FloatArray] = {}
        self._support = GrowingSupport(self._bases)
        self._requested_support: SupportSet | None = None
        self._solution_support: dict[str, SupportSet | None] = {}
        self._chain_prior: ChainBelief | None = None
        self.belief: ChainBelief | None = None
        self.wide: ChainBelief | None = None
        self.residual: ResidualModel | None = None

    def best(self, current: str) -> str:
        """Return the best model; `current` if there is nothing to compare."""
        return self._comparison.best(self._trusted, current)

    def best_map(self, current: str) -> str:
        """Return the best of the models that are KB-Maps; `current` if there is nothing to compare."""
        return self._comparison.best([name for name in self._trusted if name != RESIDUAL], current)

    def recent(self, answering: str) -> Recent:
        """Return the models' errors on the last pairs, each of the age of the newest solution."""
        return self._comparison.recent(answering)

    @property
    def support(self) -> SupportSet | None:
        """Support of the data with the current tool; None without data."""
        return self._support.view

    @property
    def noise_m(self) -> float:
        """Noise of the measurements: RMS distance from the truth [m], as claimed with them."""
        return float(np.sqrt(self.errors[PRIOR].noise_variance.sum()))

    def change_tool(self, expected_m: float, answered: str = PRIOR) -> None:
        """Reset the models' errors for another tool; `set_prior` sets the posterior of the arm.

        The solved model that answered with the last tool is trusted first with this one, because the arm is the same.
        """
        if answered in SOLVED:
            self._trusted = (answered, *(name for name in TRUSTED if name != answered))
        self._previous_discrepancies |= self._discrepancies
        self._begin(expected_m)

    def set_prior(self, belief: ChainBelief) -> None:
        """Set the prior of the chain before the first pair with the current tool."""
        self._chain_prior = belief

    def fitted(self, belief: ChainBelief) -> None:
        """Set the posterior of the chain from the first pairs, before any solution."""
        self.belief = self.wide = belief

    def is_untested(self, name: str) -> bool:
        """Return True if this model has a solution that has predicted too few pairs to be compared."""
        return name in self._discrepancies and not self._comparison.compares(name)

    def predicted(
        self,
        points: QueryPoints,
        x: FloatArray,
        predictions: Mapping[str, FloatArray],
        variances: FloatArray,
        delayed: FloatArray | None = None,
    ) -> None:
        """Record pairs, in order, each of which was predicted before it was learnt.

        Args:
            points: their q (n, d) [rad].
            x: measured positions (n, 3) [m].
            predictions: predictions of x (n, 3) [m] by model.
            variances: variances of the measurements (n, 3) [m²].
            delayed: predictions of the instant learner as old as the solutions (n, 3) [m]. On a path, a few pairs make
                a difference, so the models are compared at the same age.
        """
        for name, predicted in predictions.items():
            errors = x - predicted
            expected_variance = self.of(name, lambda _, predicted=predicted: predicted).variance_at(points) + variances
            self.errors[name].add(errors, variances, np.square(errors).sum(axis=1) / expected_variance.sum(axis=1))
        compared = dict(predictions) if delayed is None else {**predictions, INSTANT: delayed}
        self._comparison.add({name: np.square(x - each).sum(axis=1) for name, each in compared.items()})

    def learnt(self, q: FloatArray) -> None:
        """Record that pairs have been learnt at q (n, d) [rad]."""
        self._support.add(q)

    def replayed(self, errors: FloatArray) -> None:
        """Record errors (n, 3) [m] of the instant learner at pairs that it has learnt before."""
        self._residuals = self._residuals or ErrorMemory(self._expected_m)
        self._residuals.add(errors, self.errors[PRIOR].noise_variance)

    def record_request(self) -> None:
        self._requested_support = self._support.view

    def record_solution(
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
        self._solution_support[name] = self._requested_support
        if isinstance(belief, ResidualModel):
            self.residual = belief
        elif belief is not None:
            self.belief, self.wide = belief, wide or belief
        noise = np.broadcast_to(self.errors[PRIOR].noise_variance, errors.shape)
        noise = noise if variances is None else np.where(np.isfinite(variances), variances, noise)
        before = self._previous_discrepancies.get(name, self._previous_discrepancies.get(RIGID, np.zeros(3)))
        scatter = 0.0 if belief is None else belief.noise
        self._discrepancies[name] = model_discrepancy(errors, noise, before, neighbours=neighbours, scatter=scatter)

    def record_late_errors(
        self, name: str, predict: Predict, q: FloatArray, errors: FloatArray, instant: FloatArray, *, restart: bool
    ) -> None:
        """Record the errors of a new solution on the last pairs, none of which it was fitted to.

        Args:
            name: the model.
            predict: its positions (n, 3) [m] at q (n, d) [rad].
            q: configurations (n, d) [rad], in order.
            errors: measured minus predicted (n, 3) [m].
            instant: the same errors of the instant learner at the time of the request. NaN if it had already learnt the
                pair, which would be an unfair advantage.
            restart: True if it knows so much more than the last solution that the latter's errors no longer apply.
        """
        if restart:
            self._comparison.forget(name)
            self.errors[name] = ErrorMemory(self._expected_m)
        for each, errors_of_each in ((name, errors), (INSTANT, instant)):
            self._comparison.add_late(each, np.square(errors_of_each).sum(axis=1))
        noise = self.errors[PRIOR].noise_variance
        expected_variance = self.of(name, predict).variance(q) + noise
        self.errors[name].add(errors, noise, np.square(errors).sum(axis=1) / expected_variance.sum(axis=1))

    def reset_comparison(self) -> None:
        """Drop the comparison, because some pairs do not belong to this tool."""
        self._comparison = PrequentialComparison()

    def record_new_prior(self, errors: FloatArray) -> None:
        """Record another prior for the same pairs; its errors (n, 3) [m] at them."""
        noise = self.errors[PRIOR].noise_variance
        self.errors[PRIOR] = ErrorMemory(self._expected_m)
        self._comparison.forget(PRIOR)
        self.errors[PRIOR].add(errors, noise)

    def of(self, name: str, predict: Predict | None = None) -> PredictiveUncertainty:
        """Return the predictive uncertainty of one model.

        Args:
            name: the model.
            predict: its positions (n, 3) [m] at q (n, d) [rad]; None before the model exists.
        """
        memory = self.errors.get(name, ErrorMemory(self._expected_m))
        belief = self.belief or self._chain_prior
        if belief is None or predict is None:
            return PredictiveUncertainty(memory.sigma)
        none = np.zeros(3)
        if name in SOLVED:
            chain = self.residual if name == RESIDUAL and self.residual is not None else belief
            return PredictiveUncertainty(
                self._discrepancies.get(name, none), (ChainTerm(chain), self._unmodelled_term(name)), memory.inflation
            )
        if name == PRIOR:
            # The prior is a chain too, or was learnt with the last tool, so it has such a chain's discrepancy.
            in_sample = self._discrepancies.get(RIGID, self._previous_discrepancies.get(RIGID, none))
            departure = DepartureTerm(predict, belief)
        else:
            in_sample = (memory if self._residuals is None else self._residuals).sigma
            departure = DepartureTerm(predict, belief, self.support)
        return PredictiveUncertainty(
            in_sample, (ChainTerm(belief), departure, self._unmodelled_term(RIGID)), memory.inflation
        )

    def _unmodelled_term(self, name: str) -> VarianceTerm:
        """Return the term for the arm's deviation from the chain away from data: as large as at the data."""
        discrepancy = self._discrepancies.get(RESIDUAL if name == RESIDUAL else RIGID, np.zeros(3))
        return VarianceTerm(self._solution_support.get(name), float(np.sqrt(np.square(discrepancy).mean())))

    def state(self) -> UncertaintyState:
        """Return everything needed to resume, except `arrays`."""
        return UncertaintyState(
            errors=self.errors,
            judged=self._comparison.pairs,
            trusted=self._trusted,
            residuals=self._residuals,
            misfits={name: _triple(discrepancy) for name, discrepancy in self._discrepancies.items()},
            misfits_before={name: _triple(discrepancy) for name, discrepancy in self._previous_discrepancies.items()},
            belief=None if self.belief is None else self.belief.to_bytes(),
            wide=None if self.wide is None else self.wide.to_bytes(),
            residual=None if self.residual is None else self.residual.to_bytes(),
        )

    def arrays(self) -> dict[str, FloatArray]:
        """Return the configurations (n, d) [rad] that represent all data, and squared errors (k,) [m²] by model."""
        return {_SUPPORT: self._support.configurations} | {
            _CONTEST + name: values.copy() for name, values in self._comparison.errors.items()
        }

    def restore(self, state: UncertaintyState, arrays: Mapping[str, FloatArray]) -> None:
        """Resume from a state and its `arrays`."""
        self._support.add(arrays[_SUPPORT])
        self.errors, self._residuals = dict(state.errors), state.residuals
        squares = {name.removeprefix(_CONTEST): v for name, v in arrays.items() if name.startswith(_CONTEST)}
        self._comparison = PrequentialComparison(squares, state.judged)
        self._discrepancies = {name: np.array(discrepancy) for name, discrepancy in state.misfits.items()}
        self._trusted = state.trusted
        self._previous_discrepancies = {
            name: np.array(discrepancy) for name, discrepancy in state.misfits_before.items()
        }
        self.belief = None if state.belief is None else ChainBelief.from_bytes(state.belief)
        self.wide = None if state.wide is None else ChainBelief.from_bytes(state.wide)
        self.residual = None if state.residual is None else ResidualModel.from_bytes(state.residual)
        self._requested_support = self._support.view
        self._solution_support = dict.fromkeys(self._discrepancies, self._requested_support)


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
        inliers = _inliers(errors, scatter)
        errors, noise = errors[inliers], noise[inliers]
    n = len(errors)
    if neighbours and n > 1:
        variance = (errors[1:] * errors[:-1]).mean(axis=0)
        chance = np.square(errors).mean(axis=0) / math.sqrt(n - 1)
    else:
        square = np.square(errors).mean(axis=0)
        freedom_factor = max(scatter**2 / max(float(square.mean()), 1e-300), 1.0)
        variance = freedom_factor * square - noise.mean(axis=0)
        chance = np.sqrt(2.0 * freedom_factor * np.square(noise).mean(axis=0) / n)
    discrepancy = np.where(variance > ContestSettings.clearly * chance, variance, 0.0)
    prior_weight = max(UncertaintySettings.warm_pairs - n, 0.0)
    return np.sqrt((n * discrepancy + prior_weight * np.square(before)) / max(n, UncertaintySettings.warm_pairs))


def _inliers(errors: FloatArray, scatter: float) -> NDArray[np.bool_]:
    """Return the mask of errors that the fit has not left out; all if these are the minority: then the fit is off."""
    inliers = np.linalg.norm(errors, axis=1) <= RobustSettings.outlier_sigmas * scatter
    return inliers if inliers.mean() > 0.5 else np.ones_like(inliers)
