"""Fit the parameters of effects to measured positions, some of which are outliers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects import Effect, PipelineRun, Simulation
from bodyschema.interfaces.records import FloatArray

from .background import Background, BackgroundSettings, Scales
from .noise import Noise, NoiseSettings, correlation
from .observations import IntArray, Observations
from .tangent import Tangent, solved


class FitSettings:
    """Settings of the fit.

    Sensitivity, each at 0.3 and 3 times over seven recordings with hidden errors: `rounds`, `enough`, `min_rise` and
    `left_over` end fits earlier or later, which changes texts of up to three reports, and a figure by 90 % at most, of
    a rejected cause; `slack` and `little` change one by 9 % at most, a rival's probability. The others: 2 % at most.
    """

    # Maximum of steps, and the rise of the likelihood below which the fit has converged [nats].
    rounds, enough = 12, 0.02
    # Give up a fit if this multiple of the next step's promise, and this much more [nats], would not suffice.
    slack, little = 2.0, 5.0
    min_rise = 1e-3  # a step that promises a smaller rise is not tried [nats]
    # Largest share of a step's squares that kept derivatives may leave to the next: the square of their relative error.
    # With 0.3 to 3 times this, four recordings had the same causes, probabilities to 0.001 and RMS to 0.01 %.
    left_over = 3e-3
    untold = 10.0  # uncertainty, in steps that are still valid, of a period or a time constant that is not identifiable
    blocks = 60  # blocks of time whose disagreement widens the intervals
    # Scales of the tolerances over which intervals are integrated, in standard deviations of their logarithm: 5 to 39
    # change an interval by 3 %. The span, at 0.3 and 3 times: by 5 % on four recordings, by - 26 and + 11 % where the
    # tolerances are half of what they should be.
    nodes = np.linspace(-3.0, 3.0, 13)
    # A direction is left out if tolerances absorb less than this share of it: 1e-9 gave the same within 0.001 nats.
    unabsorbed = 1e-6
    largest = 10.0  # prior limit of an effect, in units of its usual size; unidentifiable parameters stay near zero


@dataclass(frozen=True, eq=False)
class Fit:
    """A simulation fitted to observations."""

    observations: Observations  # the data of the fit
    simulation: Simulation  # with all effects, the nuisances first
    nuisances: int  # number of leading effects that are not findings
    background: Background  # changes that the tolerances allow
    tolerance_amounts: FloatArray  # amount of each of them (p,)
    run: PipelineRun  # the simulation over the observed motion
    residuals: FloatArray  # (n, 3) in units of the stated noise
    noise: Noise  # the fitted noise model
    tangent: Tangent | None = None  # derivatives about a similar fit, for the first steps, or None

    @property
    def causes(self) -> tuple[Effect, ...]:
        return self.simulation.effects[self.nuisances :]

    @cached_property
    def without_outliers(self) -> float:
        """Log-likelihood if all fixes were the marker [nats]."""
        squares = np.square(self.residuals[self.observations.trusted]).sum(axis=1)
        variance = max(float(squares.mean()) / 3.0, NoiseSettings.rounded**2)
        return float(-1.5 * len(squares) * (np.log(2.0 * np.pi * variance) + 1.0))

    @cached_property
    def row_log_likelihoods(self) -> FloatArray:
        """Log-likelihood of each row (n,) [nats]; 0 for untrusted rows."""
        squares, noise = np.einsum("ni,ni->n", self.residuals, self.residuals), self.noise
        inlier = np.log1p(-noise.share) - 1.5 * np.log(2.0 * np.pi * noise.sigma**2) - 0.5 * squares / noise.sigma**2
        either = np.logaddexp(inlier, np.log(noise.share) + self.observations.outlier_density)
        return np.where(self.observations.trusted, either, 0.0)

    @property
    def is_exact(self) -> bool:
        """True if only numerical rounding is left, as for the simulation's own output."""
        return self.noise.sigma <= NoiseSettings.rounded

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the observations minus the prior cost of large effects and tolerances [nats]."""
        return self.noise.log_likelihood - self.prior_cost

    @property
    def prior_cost(self) -> float:
        """Prior cost of large effects and tolerances [nats]."""
        beyond = 0.5 * float(self.background.precision @ np.square(self.tolerance_amounts))
        beyond += self.background.occam_cost(self.noise.sigma)
        for effect in self.simulation.effects[self.nuisances :]:
            for k in effect.amounts:
                beyond += float(0.5 * (effect.values[k] / (FitSettings.largest * effect.parameters[k].usual)) ** 2)
        return beyond

    @cached_property
    def predicted(self) -> FloatArray:
        """Predicted measurements (n, 3) [m] with all effects and tolerances."""
        return self.run.measured + self.background.shift(self.tolerance_amounts)

    @cached_property
    def precision(self) -> FloatArray:
        """Prior precision of the amounts of all effects, then of the tolerances (p,)."""
        return np.append(prior_precision(self.simulation, self.nuisances), self.background.precision)

    @cached_property
    def root_weights(self) -> FloatArray:
        """Square roots of the weights (n, 1)."""
        return np.sqrt(self.noise.weights)[:, None]

    @property
    def derivatives(self) -> FloatArray:
        """Derivatives (n, 3, p) of the predictions by all amounts, and then by all tolerances [m]."""
        return np.concatenate([amount_columns(self.run, self.simulation.effects), self.background.columns], axis=2)

    @property
    def columns(self) -> FloatArray:
        return np.concatenate(
            [self.effect_columns, self.tolerance_columns.reshape(*self.weighted_residuals.shape, -1)], axis=2
        )

    @cached_property
    def effect_columns(self) -> FloatArray:
        """Derivatives (n, 3, p) of the predictions by the amounts of all effects, whitened and weighted."""
        return self._white_columns * self.root_weights[:, :, None]

    @cached_property
    def _white_columns(self) -> FloatArray:
        """Derivatives (n, 3, p) of the predictions by the amounts of all effects, whitened."""
        return self.observations.whitened(amount_columns(self.run, self.simulation.effects))

    @property
    def tolerance_columns(self) -> FloatArray:
        """Derivatives (3 n, p) of the predictions by all tolerances, whitened and weighted."""
        return self.background.white * np.repeat(self.root_weights, 3, axis=0)

    @property
    def amounts(self) -> int:
        return sum(len(effect.amounts) for effect in self.simulation.effects)

    def unknown_history(self, effects: Iterable[Effect] | None = None) -> NDArray[np.bool_]:
        """Return rows (n,) whose history is not known well enough for some effects, by default for all."""
        rows = np.zeros(len(self.observations), dtype=np.bool_)
        for effect in self.simulation.effects if effects is None else effects:
            rows |= effect.kind.unknown_state(self.run, effect)
        return rows

    @property
    def unknown_history_at_first(self) -> NDArray[np.bool_]:
        """Rows (n,) before the first one with known history, if the arm goes straight from each run to the next."""
        rows = np.zeros(len(self.observations), dtype=np.bool_)
        joined = replace(self.run, motion=self.run.motion.joined)
        for effect in self.simulation.effects:
            rows[1:] |= np.logical_and.accumulate(effect.kind.unknown_state(joined, effect)[1:])
        return rows

    def weighted(self, columns: FloatArray) -> FloatArray:
        """Return columns (n, 3, p) [m] whitened and weighted."""
        return self.observations.whitened(columns) * self.root_weights[:, :, None]

    @property
    def independence(self) -> float:
        """Effective number of independent rows per row (0 to 1], from the lag-1 correlation: (1 - ρ) / (1 + ρ)."""
        return (1.0 - self.correlation) / (1.0 + self.correlation)

    @cached_property
    def correlation(self) -> float:
        """Correlation of the residuals of neighbouring rows [0, 1); 0 within two standard errors."""
        return correlation(self.weighted_residuals, self.observations.motion.begins)

    @cached_property
    def absorbed_directions(self) -> tuple[FloatArray, FloatArray]:
        """Orthonormal directions (3 n, r) that tolerances change, and the absorbed share of the squares in each (r,).

        Tests treat the background as noise shared among the rows (Rasmussen and Williams 2006, 2.7).
        """
        tolerances = self.background.tolerances
        inner = self.background.inner(self.noise.weights) * np.outer(tolerances, tolerances)
        values, vectors = np.linalg.eigh(inner)
        there = values > FitSettings.unabsorbed * self.noise.sigma**2
        values, vectors = values[there], vectors[:, there]
        directions = self.tolerance_columns @ (tolerances[:, None] * vectors / np.sqrt(values))
        return directions, values / (values + self.noise.sigma**2)

    def fully_whitened(self, flat: FloatArray) -> FloatArray:
        """Return weighted columns (3 n, k) in units in which background and noise together are white."""
        directions, shares = self.absorbed_directions
        if not len(shares):
            return flat
        return flat - directions @ ((1.0 - np.sqrt(1.0 - shares))[:, None] * (directions.T @ flat))

    @cached_property
    def whitened_residuals(self) -> FloatArray:
        """Residuals of the effects (n, 3), weighted and `fully_whitened`."""
        return self.whitened_residuals_of(self.run.measured)

    def whitened_residuals_of(self, predicted: FloatArray) -> FloatArray:
        """Return the residuals of a prediction (n, 3) [m] by effects, weighted and `fully_whitened` (n, 3)."""
        without_tolerances = self.background.shift(np.zeros_like(self.tolerance_amounts))
        left = self.observations.residuals(predicted + without_tolerances) * self.root_weights
        return self.fully_whitened(left.reshape(-1, 1)).reshape(left.shape)

    @cached_property
    def effect_basis(self) -> FloatArray:
        """Orthonormal basis (n, 3, r) of the directions that the amounts of effects can change, `fully_whitened`."""
        n = len(self.weighted_residuals)
        flat = self.fully_whitened(self.effect_columns.reshape(3 * n, self.amounts))
        scales = np.linalg.norm(flat, axis=0)
        q, r = np.linalg.qr(flat / np.where(scales > 0.0, scales, 1.0))
        left, values, _ = np.linalg.svd(r)
        return (q @ left[:, values > 1e-9 * max(values.max(initial=0.0), 1e-300)]).reshape(n, 3, -1)

    @cached_property
    def weighted_residuals(self) -> FloatArray:
        """Weighted residuals (n, 3)."""
        return self.residuals * self.root_weights

    @cached_property
    def shape_columns(self) -> FloatArray:
        """Derivatives (n, 3, s) of the predictions by all periods and time constants, whitened and weighted."""
        parts = [self.run.by_shape(effect) for effect in self.causes if effect.shapes]
        return self.weighted(np.concatenate(parts, axis=2)) if parts else np.empty((len(self.run.motion), 3, 0))

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of all amounts (p, p), nuisances first, then of periods and time constants.

        It is widened where blocks of time disagree by more than independent rows would (Liang and Zeger 1986), and for
        the uncertainty of the tolerances' scales.
        """
        columns = np.concatenate([self.columns, self.shape_columns], axis=2)
        flat, variance = columns.reshape(self.weighted_residuals.size, -1), self.noise.sigma**2
        precision = np.append(self.precision, self._shape_precision / FitSettings.untold**2)
        information = flat.T @ flat / variance + np.diag(precision)
        # Normalise the units, since seconds and radians differ widely in size.
        units = np.outer(scales := np.sqrt(np.diag(information)), scales)
        covariance = np.asarray(np.linalg.pinv(information / units, rcond=1e-14, hermitian=True) / units)
        scores = np.einsum("nip,ni->np", columns, self.weighted_residuals) / variance
        firsts = np.unique(np.linspace(0, len(scores), FitSettings.blocks, endpoint=False).astype(int))
        moved = np.add.reduceat(scores, firsts, axis=0) @ covariance
        ratio = np.square(moved).sum(axis=0) / np.maximum(np.diag(covariance), 1e-300)
        products = information - np.diag(precision)
        wider = np.sqrt(np.maximum(ratio, 1.0) * self._widening_by_scales(products, scores.sum(axis=0), precision))
        return covariance * np.outer(wider, wider)

    def _widening_by_scales(self, products: FloatArray, scores: FloatArray, precision: FloatArray) -> FloatArray:
        """Return the factors (p,) of the variances when the scales of the tolerances are integrated over.

        If an offset is wrong, the rotation of its link within tolerances is only known to within their scale.

        Args:
            products: information (p, p) of the data about all parameters.
            scores: derivatives (p,) of the log-likelihood.
            precision: prior precision (p,).
        """
        if self.background.scales is None:
            return np.ones(len(precision))
        own = [effect.values[effect.amounts] for effect in self.simulation.effects]
        now = np.concatenate([*own, self.tolerance_amounts])
        now = np.append(now, np.zeros(len(precision) - len(now)))
        first = self.amounts
        groups = np.full(len(precision), -1)
        groups[first : first + len(self.tolerance_amounts)] = self.background.group
        units = 1.0 / np.sqrt(np.diag(products) + precision)
        # Relative to the fit: an instrument metres away would leave only rounding of the evidence.
        inner, rhs, now, prior = products * np.outer(units, units), scores * units, now / units, precision * units**2
        factors = np.ones(len(precision))
        here = _posteriors(inner, rhs, now, prior[None])
        for g, scale in enumerate(self.background.scales):
            mine = groups == g
            effective_dof = float(mine.sum() - (here.variances[0] * prior)[mine].sum())
            unsure = 1.0 / np.sqrt(2.0 * max(effective_dof, 0.0) + 1.0 / BackgroundSettings.spread**2)
            logs = np.log(scale) + unsure * FitSettings.nodes
            logs = logs[logs < np.log(BackgroundSettings.largest_scale) + FitSettings.enough]
            other = np.where(mine, np.exp(-2.0 * (logs - np.log(scale)))[:, None], 1.0) * prior
            tried = _posteriors(inner, rhs, now, other)
            of_scale = 0.5 * np.square(logs / BackgroundSettings.spread)
            evidence = tried.evidence + 0.5 * np.log(other[:, mine]).sum(axis=1) - of_scale
            weights = np.exp(evidence - evidence.max())
            weights /= weights.sum()
            squares = tried.variances + np.square(tried.means - here.means[0])
            factors += np.maximum(weights @ squares / here.variances[0] - 1.0, 0.0)
        return factors

    @property
    def _shape_precision(self) -> FloatArray:
        """Prior precision of periods and time constants (s,), from the limit of one step."""
        reaches = [effect.kind.shape_step(self.run, effect, k) for effect in self.causes for k in effect.shapes]
        return 1.0 / np.square(np.array(reaches))

    @cached_property
    def tangent_here(self) -> Tangent:
        return Tangent.of(self.simulation.effects, self._columns_of_each(None), self.background, self.noise.weights)

    @property
    def tangent_from_similar(self) -> Tangent:
        """Derivatives about this fit; those of effects in `tangent` are taken from it."""
        if self.tangent is None or len(self.tangent.weights) != len(self.weighted_residuals):
            return self.tangent_here
        columns = self._columns_of_each(self.tangent)
        return Tangent.of(self.simulation.effects, columns, self.background, self.noise.weights, self.tangent)

    def _columns_of_each(self, near: Tangent | None) -> list[FloatArray]:
        """Return derivatives (3 n, k) by the amounts and shapes of each effect, whitened, or taken from `near`."""
        known = {} if near is None else dict(zip(map(id, near.effects), near.columns, strict=True))
        shaped = {id(effect) for effect in self.causes if effect.shapes}
        ends = np.cumsum([0, *(len(effect.amounts) for effect in self.simulation.effects)])
        found = []
        for effect, (first, end) in zip(self.simulation.effects, pairwise(ends), strict=True):
            if id(effect) in known:
                found.append(known[id(effect)])
                continue
            if near is None:
                own = self._white_columns[:, :, first:end]
            else:
                own = self.observations.whitened(amount_columns(self.run, [effect]))
            if id(effect) in shaped:
                own = np.concatenate([own, self.observations.whitened(self.run.by_shape(effect))], axis=2)
            found.append(own.reshape(self.weighted_residuals.size, -1))
        return found

    def step(self, tangent: Tangent | None = None) -> tuple[FloatArray, float]:
        """Return the Gauss-Newton step of amounts, periods and time constants, and the expected rise of the likelihood.

        Args:
            tangent: derivatives about a similar fit with the same effects; this fit's own by default.

        Returns:
            The step (p + s,), and the rise [nats].
        """
        tangent = tangent or self.tangent_here
        precision = np.append(self.precision, self._shape_precision) * self.noise.sigma**2
        own = [effect.values[effect.amounts] for effect in self.simulation.effects]
        values = np.concatenate([*own, self.tolerance_amounts])
        places = self._tangent_indices
        normal = tangent.normal[np.ix_(places, places)]
        gradient = tangent.gradient(self.weighted_residuals * self.root_weights)[places]
        normal[np.diag_indices_from(normal)] += precision
        gradient[: len(values)] -= precision[: len(values)] * values
        step = solved(normal, gradient)
        return step, 0.5 * float(step @ gradient) / self.noise.sigma**2

    def loss(self, cause: Effect) -> float:
        """Return the fall of the log-likelihood without a cause, all else refitted, to first order [nats]."""
        places = self.places(cause)[: len(cause.amounts)]
        own = cause.values[cause.amounts]
        lost = 0.5 * float(own @ solved(self._posterior[np.ix_(places, places)], own))
        half_square = 1.5 * float(self.noise.weights.sum())
        return half_square * float(np.log1p(lost / max(half_square, 1e-300)))

    @cached_property
    def _posterior(self) -> FloatArray:
        """Covariance (p + s, p + s) of all amounts, tolerances, periods and time constants, for independent rows."""
        places = self._tangent_indices
        normal = self.tangent_here.normal[np.ix_(places, places)] / self.noise.sigma**2
        normal[np.diag_indices_from(normal)] += np.append(self.precision, self._shape_precision)
        scales = np.sqrt(np.diag(normal))
        return np.asarray(np.linalg.pinv(normal / np.outer(scales, scales), 1e-12, True)) / np.outer(scales, scales)

    @property
    def _tangent_indices(self) -> IntArray:
        """Places in a tangent of all amounts, then of the tolerances, then of periods and time constants (p + s,)."""
        amounts, shapes, last = [], [], 0
        for index, effect in enumerate(self.simulation.effects):
            own = len(effect.shapes) if index >= self.nuisances else 0
            amounts += [*range(last, last + len(effect.amounts))]
            last += len(effect.amounts) + own
            shapes += [*range(last - own, last)]
        return np.array([*amounts, *range(last, last + len(self.tolerance_amounts)), *shapes], dtype=np.intp)

    def places(self, cause: Effect) -> list[int]:
        """Return the indices in `covariance` of a cause's amounts, then of its periods and time constants."""
        amounts, shapes = 0, self.amounts + len(self.tolerance_amounts)
        for index, effect in enumerate(self.simulation.effects):
            own = effect.shapes if index >= self.nuisances else []
            if effect is cause:
                return [*range(amounts, amounts + len(effect.amounts)), *range(shapes, shapes + len(own))]
            amounts, shapes = amounts + len(effect.amounts), shapes + len(own)
        raise ValueError(f"{cause.name} is no effect of this fit")

    def after_step(self, step: FloatArray) -> Fit:
        """Return the fit after a step (p + s,), without further steps."""
        effects, first = [], 0
        shape = self.amounts + len(self.tolerance_amounts)
        for index, effect in enumerate(self.simulation.effects):
            values = effect.values.copy()
            values[effect.amounts] += step[first : first + len(effect.amounts)]
            first += len(effect.amounts)
            if index >= self.nuisances:
                for k in effect.shapes:
                    values[k] = effect.kind.bounded(effect, k, values[k] + step[shape], self.observations.motion)
                    shape += 1
            effects.append(effect.with_values(values))
        tolerance_amounts = self.tolerance_amounts + step[first : first + len(self.tolerance_amounts)]
        return self.at(self.simulation.with_effects(effects), tolerance_amounts)

    def at(self, simulation: Simulation, tolerance_amounts: FloatArray | None = None) -> Fit:
        """Evaluate a simulation with the same nuisances, and the same tolerances by default, without fitting it."""
        tolerance_amounts = self.tolerance_amounts if tolerance_amounts is None else tolerance_amounts
        return _at(self.observations, simulation, self.nuisances, self.noise, self.background, tolerance_amounts)

    def over(self, observations: Observations) -> Fit:
        return improved(self._linearised_about(self.simulation_with_tolerances, self.background.scales, observations))

    def _linearised_about(
        self, simulation: Simulation, scales: Scales | None, observations: Observations | None = None
    ) -> Fit:
        """Evaluate a simulation with tolerances that are linearised about it, without fitting it."""
        observations = self.observations if observations is None else observations
        run, before = simulation.run(observations.motion), None if scales is None else self.background
        background = Background(run, observations.whitening, scales, before)
        return _at(observations, simulation, self.nuisances, self.noise, background, run=run)

    def to(self, observations: Observations, start: Simulation | None = None) -> Fit:
        """Refit to other observations of the same motion, optionally from another simulation."""
        simulation = start or self.simulation
        fit = _at(observations, simulation, self.nuisances, self.noise, self.background, self.tolerance_amounts)
        return improved(replace(fit, tangent=self.tangent_here))

    def with_tolerances(self, scales: Scales, also: Collection[Effect] = ()) -> Fit:
        """Refit with tolerances of these scales, linearised about their present values.

        Args:
            also: further tolerances; those among the causes are no longer findings.
        """
        simulation = self.simulation_with_tolerances
        if also:
            stays = [effect for effect in simulation.effects if effect not in also]
            moved = [effect.with_ordinal(-2 - k) for k, effect in enumerate(also)]
            simulation = simulation.with_effects(stays).with_background((*simulation.background, *moved))
        return improved(self._linearised_about(simulation, scales))

    def with_tolerances_from_nominal(self, scales: Scales) -> Fit:
        """Refit with tolerances of these scales, linearised about an arm without any."""
        before = self.background
        bare = self.simulation.with_background(before.with_amounts(np.zeros_like(before.start)))
        return improved(self._linearised_about(bare, scales))

    def with_tolerances_applied(self) -> Fit:
        """Return the same fit with its tolerances moved into the simulation."""
        if self.background.scales is None:
            return self
        return self._linearised_about(self.simulation_with_tolerances, self.background.scales)

    @property
    def simulation_with_tolerances(self) -> Simulation:
        if self.background.scales is None:
            return self.simulation
        return self.simulation.with_background(self.background.with_amounts(self.tolerance_amounts))

    @property
    def written(self) -> Simulation:
        """Return the simulation to be stored: tolerances as found, and everything else refitted beside them.

        Tolerances are found to first order. If a link rotates one way and the camera the other, their second-order
        terms remain. Rows that were ignored because of other causes count here.
        """
        if self.is_exact:
            return self.simulation
        observations = (
            replace(self.observations, play_covariance=None)
            if self.unknown_history().any()
            else self.observations.without_history
        )
        return improved(self._linearised_about(self.simulation_with_tolerances, None, observations)).simulation

    def without_tolerances(self) -> Fit:
        """Refit without any tolerance."""
        if self.background.scales is None:
            return self
        return improved(self._linearised_about(self.simulation.with_background(self.background.given), None))

    def without(self, cause: Effect) -> Fit:
        return self.with_causes([effect for effect in self.causes if effect.identity != cause.identity])

    def with_causes(self, causes: Sequence[Effect]) -> Fit:
        return improved(self.with_unfitted_causes(causes))

    def with_unfitted_causes(self, causes: Sequence[Effect]) -> Fit:
        """Replace the causes, without fitting."""
        started = self.at(self.simulation.with_effects((*self.simulation.effects[: self.nuisances], *causes)))
        return replace(started, tangent=self.tangent_here)


def fitted(observations: Observations, simulation: Simulation, nuisances: int, start: Noise | None = None) -> Fit:
    """Fit the most probable amounts of all effects of `simulation`, by damped Gauss-Newton steps.

    Periods and time constants of the causes are fitted too; moments stay fixed. There are no tolerances.
    """
    run = simulation.run(observations.motion)
    background = Background(run, observations.whitening, None)
    return improved(_at(observations, simulation, nuisances, start, background, run=run))


def improved(fit: Fit, threshold: float = -np.inf) -> Fit:
    """Refit the parameters of a fit by Gauss-Newton steps, as in `fitted`.

    Derivatives are recomputed only if a step reduces the residuals by less than expected (Shamanskii 1967).

    Args:
        threshold: log-likelihood to reach; the fit is abandoned once it is unlikely to be reached [nats].
    """
    if not fit.simulation.effects and not len(fit.tolerance_amounts):
        return fit
    tangent, is_fresh, before = fit.tangent_from_similar, fit.tangent is None, np.inf
    for done in range(FitSettings.rounds):
        step, predicted_rise = fit.step(tangent)
        # In squares, since the noise falls as well.
        square = predicted_rise * fit.noise.sigma**2
        if not is_fresh and square > FitSettings.left_over * before:
            tangent, is_fresh = fit.tangent_here, True
            step, predicted_rise = fit.step(tangent)
            square = predicted_rise * fit.noise.sigma**2
        hopeless = fit.log_likelihood + FitSettings.slack * _rise(predicted_rise, fit) + FitSettings.little < threshold
        if predicted_rise < FitSettings.min_rise or (done and hopeless):
            return fit
        best = _line_search(fit, step)
        if best is None and not is_fresh:
            tangent, is_fresh, before = fit.tangent_here, True, np.inf
            best = _line_search(fit, fit.step(tangent)[0])
        if best is None:
            return fit
        gained = best.log_likelihood - fit.log_likelihood
        fit, is_fresh, before = best, False, square
        if gained < FitSettings.enough:
            break
    return fit


def _line_search(fit: Fit, step: FloatArray) -> Fit | None:
    """Return the fit after the part of a step that raises its likelihood; None if no part does."""
    for shortened in (1.0, 0.3, 0.05):
        tried = fit.after_step(shortened * step)
        if tried.log_likelihood > fit.log_likelihood:
            return tried
    return None


class _Posteriors(NamedTuple):
    """Gaussian posteriors for m priors: means relative to a fit and variances (m, p), and log-evidence (m,).

    The evidence is without the volumes of the priors.
    """

    means: FloatArray
    variances: FloatArray
    evidence: FloatArray


def _posteriors(inner: FloatArray, scores: FloatArray, now: FloatArray, precision: FloatArray) -> _Posteriors:
    """Return the posteriors under priors about 0, from the likelihood's derivatives (p, p), (p,) at amounts `now` (p,).

    Args:
        precision: prior precisions (m, p).
    """
    information = inner + (precision + np.finfo(np.float64).eps)[:, :, None] * np.eye(len(scores))
    covariances, rhs = np.linalg.inv(information), scores - precision * now
    means = np.einsum("mpq,mq->mp", covariances, rhs)
    evidence = 0.5 * (means * rhs).sum(axis=1) - 0.5 * precision @ np.square(now)
    return _Posteriors(means, np.einsum("mpp->mp", covariances), evidence - 0.5 * np.linalg.slogdet(information)[1])


def _rise(predicted_rise: float, fit: Fit) -> float:
    """Return the rise of the log-likelihood after a step when the noise estimate falls as well."""
    half_square = 1.5 * float(fit.noise.weights.sum())
    return -half_square * float(np.log1p(-min(predicted_rise / max(half_square, 1e-300), 0.999999)))


def _at(
    observations: Observations,
    simulation: Simulation,
    nuisances: int,
    start: Noise | None,
    background: Background,
    tolerance_amounts: FloatArray | None = None,
    run: PipelineRun | None = None,
) -> Fit:
    run = simulation.run(observations.motion) if run is None else run
    tolerance_amounts = background.start if tolerance_amounts is None else tolerance_amounts
    residuals = observations.residuals(run.measured + background.shift(tolerance_amounts))
    noise = Noise.of(residuals, observations, start, background.effective_dof)
    return Fit(observations, simulation, nuisances, background, tolerance_amounts, run, residuals, noise)


def prior_precision(simulation: Simulation, nuisances: int) -> FloatArray:
    """Return the prior precision of all amounts (p,); unknown ones have 0."""
    parts = []
    for k, effect in enumerate(simulation.effects):
        usual = np.array([effect.parameters[j].usual for j in effect.amounts])
        parts.append(1.0 / np.square((FitSettings.largest if k >= nuisances else 1e4) * usual))
    return np.concatenate(parts) if parts else np.empty(0)


def amount_columns(run: PipelineRun, effects: Sequence[Effect]) -> FloatArray:
    """Return derivatives (n, 3, p) of the predictions by the amounts of effects [m]."""
    parts = [run.columns(effect)[:, :, effect.amounts] for effect in effects]
    return np.concatenate(parts, axis=2) if parts else np.empty((len(run.motion), 3, 0))
