"""Sets of causes about one fit, each with its evidence beside the background.

Everything is linearised about the fit: a set costs its normal equations, independent of the number of rows (MacKay
1992, "Bayesian interpolation"; Tipping and Faul 2003, "Fast marginal likelihood maximisation").
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_blas_funcs, get_lapack_funcs

from bodyschema.diagnosis.fit.background import BackgroundSettings, Scales
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.net_evidence import WorthSettings, choice_counts
from bodyschema.effects import Effect, EffectType, Identity
from bodyschema.interfaces.records import FloatArray

from .scan import Candidate
from .search import Key


class SetSettings:
    # Rounds for scales and noise, from afar and beside a similar set; stop when their logarithms change by less.
    rounds, rounds_near, still = 25, 8, 0.02
    farthest = 1.0  # limit of a step in the logarithms
    quietest = 1e-3  # lower limit of the noise as a share of that of the fit
    tried = 4  # number of the most promising moves that are tried with their own scales
    # Logarithms of the sizes, in usual ones, with which a pose is tried before its own is fitted.
    log_sizes = (0.0, -2.0, -4.0)
    # Prior width of what robot.toml does not know, about the fit, in usual sizes; the same in all fits, to compare
    # them.
    free = 100.0
    # Relative rounding of squares, and of columns that are collinear up to rounding.
    rounded_off, one_beyond_rounding = 1e-13, 1e-8
    shown_nats = 3.0  # evidence loss without a scale's tolerances from which they show in the data [nats]
    # Loss of evidence that rules a scale out with 95 % (a likelihood ratio on one side), and the step of logarithms
    # tried.
    ruled_out_nats, finer = 1.35, 0.2
    # Maximum of changes to a set of causes, and of its causes for more to be added: beyond, the first order is not
    # enough.
    max_moves, max_together = 60, 8
    comes_near_nats = 15.0  # margin to the best within which a set is refitted, and a change tried [nats]


_LOG_MIN_SCALE, _LOG_MAX_SCALE = math.log(BackgroundSettings.smallest_scale), math.log(BackgroundSettings.largest_scale)
SCALES = len(Scales())

dpotrf, dpotri, dpotrs = get_lapack_funcs(("potrf", "potri", "potrs"), dtype=np.float64)
(dtrsm,) = get_blas_funcs(("trsm",), dtype=np.float64)

# Factor (p, p) of a precision, prior variances (p,), and amounts (p,).
_Solution = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class CauseSet:
    """A set of causes with its evidence."""

    chosen: tuple[int, ...]  # indices of its candidates
    net_evidence: (
        float  # its evidence less the cost of naming its causes [nats]; comparable only with that of other sets
    )
    scales: Scales  # scales of the tolerances
    logs: FloatArray  # logarithms of these scales, then of the sizes of poses in usual ones
    group: NDArray[np.int64]  # the index (p,) in `logs` of each column's prior width; -1 where it is 1
    sigma: float  # size of the noise, in units of the stated one
    effective_dof: FloatArray  # effective number of data that determine each scale (4,)
    amounts: FloatArray  # amounts of all its columns (p,)
    factor: FloatArray  # lower Cholesky factor (p, p) of their precision; entries above its diagonal have no meaning
    columns: NDArray[np.intp]  # indices of its columns (p,)

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the amounts (p, p)."""
        lower = np.tril(dpotri(self.factor, lower=True)[0])
        return lower + np.tril(lower, -1).T


class CauseSets:
    """Sets of causes beside one fit, to first order.

    Args:
        fit: a fit with a background.
        candidates: possible causes, each with the amounts, periods and moments about which it is linearised.
        naming_cost: minimum cost of naming one of them [nats].
    """

    def __init__(self, fit: Fit, candidates: Sequence[Candidate], naming_cost: float) -> None:
        columns, amounts = fit.columns, fit.effect_columns.shape[2]
        causes = sum(len(effect.amounts) for effect in fit.causes)
        found = [effect.values[effect.amounts] for effect in fit.causes]
        # Parameters unknown to robot.toml count from their fitted values, however far from nominal.
        now = np.concatenate([np.zeros(amounts - causes), *found, fit.tolerance_amounts])
        rows = fit.weighted_residuals.size
        target = fit.weighted_residuals.ravel() + columns.reshape(rows, -1) @ now
        parts = [columns[:, :, : amounts - causes], columns[:, :, amounts:]]
        self.effects = [candidate.effect for candidate in candidates]
        parts += [*_columns(fit, self.effects)]
        self._nuisances, self._tolerances = amounts - causes, len(fit.tolerance_amounts)
        self._of_scale, self._noise = fit.background.group, fit.noise.sigma
        scales = np.asarray(fit.background.scales or Scales())[fit.background.group]
        flat = np.concatenate(parts, axis=2).reshape(rows, -1)
        unknown = SetSettings.free * _usual_sizes(fit.simulation.effects[: fit.nuisances])
        self._units = np.concatenate([unknown, fit.background.tolerances / scales, _usual_sizes(self.effects)])
        flat *= self._units
        self._inner, self._rhs = flat.T @ flat, flat.T @ target
        self._square, self._rows = float(target @ target), 3.0 * float(fit.noise.weights.sum())
        # Outliers of one fit may be the marker in another, with other causes: compare all rows.
        left = float(np.square(fit.weighted_residuals).sum()) / fit.noise.sigma**2
        self._outliers = fit.noise.log_likelihood + self._rows * math.log(fit.noise.sigma) + 0.5 * left
        self._kinds, self._keys = [one.kind for one in self.effects], [one.key for one in self.effects]
        self._trials = [float(np.log(candidate.trials)) for candidate in candidates]
        self._choice_bits = [sum(1 << k for k in one.amounts) for one in self.effects]
        self._naming_cost = naming_cost + WorthSettings.named_nats
        ends = np.cumsum([0, *(len(effect.amounts) for effect in self.effects)])
        first = self._nuisances + self._tolerances
        self._places = [np.arange(first + a, first + b) for a, b in pairwise(ends)]
        self._log_max_scale = _LOG_MAX_SCALE
        self._known_places: dict[tuple[int, ...], NDArray[np.intp]] = {}
        # Numbers of one cause that are added and removed together.
        groups: dict[tuple[object, ...], list[int]] = {}
        for k, effect in enumerate(self.effects):
            for group in (k,), *_parts(effect):
                groups.setdefault(group, []).append(k)
        self._groups = [tuple(group) for group in dict.fromkeys(map(tuple, groups.values()))]
        self._known: dict[frozenset[int], CauseSet] = {}
        known = {cause.identity for cause in fit.causes}
        # The moment of each was found without the others, so it is right for at most one of them.
        self._begins = {k for k, one in enumerate(self.effects) if one.kind.begins and one.identity not in known}
        # The camera's pose and scale and the marker's position, which tolerances of adjacent links can follow.
        self._poses = [k for k, one in enumerate(self.effects) if one.kind.is_like_tolerances and not one.kind.at_joint]
        # A pose may be off by 0.05 mm or by 50. A scale is off by a few percent, as prints are.
        self._sized = [k for k in self._poses if not self.effects[k].kind.scales_all]

    def hill_climbed(self, starts: Iterable[tuple[int, ...]]) -> list[CauseSet]:
        """Improve each start by single changes, and return the sets reached, without impossible causes.

        Without them different sets may become equal.
        """
        seen: dict[frozenset[int], CauseSet] = {}
        reached = {self.without_impossible(self._hill_climb(start, seen)).chosen: None for start in starts}
        best = max(map(self.of, reached), key=lambda one: one.net_evidence)
        if best.scales.excess_over_workshop == 0.0:
            # Beside tolerances that have followed it a cause seems to be worth nothing, however small they are.
            exact, others = copy(self), dict[frozenset[int], CauseSet]()
            exact._log_max_scale, exact._known = _LOG_MIN_SCALE, {}
            near = dict.fromkeys(exact._hill_climb(start, others).chosen for start in ((), best.chosen))
            near = [
                one for one in near if self.of(one, best).net_evidence > best.net_evidence - SetSettings.comes_near_nats
            ]
            reached |= {self.without_impossible(self._hill_climb(start, seen)).chosen: None for start in near}
        return list({frozenset(chosen): self.of(chosen) for chosen in reached}.values())

    def without_impossible(self, current: CauseSet) -> CauseSet:
        """Return a set without the causes whose amounts would be impossible, such as a negative backlash."""
        absent = {cause.identity for cause in self.causes(current) if not cause.is_valid}
        if not absent:
            return current
        stays = tuple(k for k in current.chosen if self.effects[k].identity not in absent)
        return self.without_impossible(self.of(stays, current))

    def starts(self, own: tuple[int, ...], *, links: bool) -> Iterator[tuple[int, ...]]:
        """Yield the starting sets: the fit's causes, none, all joint offsets, and all effects of each kind.

        Args:
            links: also yield each pose, and each cause that may have a subset of its numbers, with all of them.
        """
        yield own
        yield ()
        steady = [effect for k, effect in enumerate(self.effects) if k not in self._begins]
        kinds = dict.fromkeys(effect.kind for effect in steady if effect.kind.at_joint and not effect.source)
        zeros = tuple(k for k, effect in enumerate(self.effects) if effect.kind.is_zero)
        for kind in kinds:
            yield tuple(k for k, effect in enumerate(self.effects) if effect.kind is kind)
        yield tuple(dict.fromkeys((*own, *zeros)))
        yield from self.zeros_for_links(own)
        for key in dict.fromkeys(effect.key for effect in self.effects if effect.kind.in_parts and links):
            yield tuple(k for k, effect in enumerate(self.effects) if effect.key == key)
        yield from ((k,) for k in self._poses if links)

    def zeros_for_links(self, own: tuple[int, ...]) -> list[tuple[int, ...]]:
        """Return the set with all joint offsets instead of its links; an empty list if it has no links."""
        zeros = [k for k, effect in enumerate(self.effects) if effect.kind.is_zero]
        others = [k for k in own if not self.effects[k].kind.in_parts]
        return [tuple(dict.fromkeys((*others, *zeros)))] if len(others) < len(own) else []

    def matching(self, effects: Iterable[Effect]) -> tuple[int, ...]:
        """Return the set of the same effects and numbers, as far as they are candidates here."""
        wanted = {(effect.key, k) for effect in effects for k in effect.amounts}
        return tuple(k for k, one in enumerate(self.effects) if (one.key, one.amounts[0]) in wanted)

    def _hill_climb(self, start: tuple[int, ...], seen: dict[frozenset[int], CauseSet]) -> CauseSet:
        current = self.of(start)
        for _ in range(SetSettings.max_moves):
            if frozenset(current.chosen) in seen:
                return seen[frozenset(current.chosen)]
            seen[frozenset(current.chosen)] = current
            better = self._without_one(current)
            if better is None and len({self.effects[k].identity for k in current.chosen}) < SetSettings.max_together:
                better = (
                    self._with_one_more(current) or self._exchanged(current) or self._with_smaller_tolerances(current)
                )
            if better is None:
                return current
            current = better
        return current

    def _without_one(self, current: CauseSet) -> CauseSet | None:
        """Remove one cause or a part of one, if that is more probable."""
        present = frozenset(current.chosen)
        groups = [group for group in self._groups if present.issuperset(group)]
        losses = self._losses(current, groups)
        for k in np.argsort(losses, kind="stable")[: SetSettings.tried].tolist():
            if losses[k] > SetSettings.comes_near_nats:
                break
            if better := _better([self.of(_without(current.chosen, groups[k]), current)], current):
                return better
        return None

    def _with_one_more(self, current: CauseSet) -> CauseSet | None:
        more = self._promising(current, current.net_evidence)
        return _better([self.of((*current.chosen, *group), current) for group in more[: SetSettings.tried]], current)

    def _exchanged(self, current: CauseSet) -> CauseSet | None:
        tried = []
        for identity in dict.fromkeys(self.effects[k].identity for k in current.chosen):
            own = tuple(k for k in current.chosen if self.effects[k].identity == identity)
            without = self.of(_without(current.chosen, own), current)
            others = [
                group
                for group in self._promising(without, current.net_evidence)
                if self.effects[group[0]].identity != identity
            ]
            tried += [self.of((*without.chosen, *group), without) for group in others[: SetSettings.tried]]
        return _better(tried, current)

    def _with_smaller_tolerances(self, current: CauseSet) -> CauseSet | None:
        """Add a link's shifts or rotations, or a pose, if the smaller tolerances then make it more probable.

        Beside tolerances as large as the link's own error it seems to be worth nothing, however large they are.
        """
        if max(current.scales.lengths, current.scales.angles) <= 1.0:
            return None
        near = replace(current, scales=current.scales.limited_to_workshop)
        added = [_without(group, current.chosen) for group in self._groups if group[0] in self._poses or len(group) > 1]
        return _better([self.of((*current.chosen, *group), near) for group in added if group], current)

    def with_one(self, current: CauseSet) -> Iterator[tuple[Effect, CauseSet]]:
        """Yield each cause that a set lacks with the best set that has it, beside tolerances that may be smaller."""
        near = replace(current, scales=current.scales.limited_to_workshop)
        own = {self._keys[k] for k in current.chosen}
        best: dict[Key, CauseSet] = {}
        for group in self._groups:
            key = self._keys[group[0]]
            if key not in own:
                one = self.of((*current.chosen, *group), near)
                best[key] = max(best.get(key, one), one, key=lambda tried: tried.net_evidence)
        yield from ((self.effects[self._keys.index(key)], one) for key, one in best.items())

    def _losses(self, current: CauseSet, groups: Sequence[tuple[int, ...]]) -> FloatArray:
        """Return the net evidence of each of some groups of numbers with scales and noise held fixed [nats]."""
        own = [np.searchsorted(current.columns, self._places_of(group)) for group in groups]
        squares, volumes = _in_groups(current.covariance, current.amounts, own)
        widths = np.append(current.logs, 0.0)[current.group]
        volumes -= [widths[places].sum() for places in own]
        return squares + volumes - self._costs_of(current.chosen, groups, are_in=True)

    def _cost(self, chosen: Sequence[int]) -> float:
        """Return the cost of naming the causes of a set [nats]."""
        total, kinds = 0.0, set[EffectType]()
        numbers: Counter[Key] = Counter()
        for k in chosen:
            kind = self._kinds[k]
            if kind.in_parts:
                numbers[self._keys[k]] += self._choice_bits[k]
                continue
            total += self._trials[k] + (WorthSettings.another_nats if kind in kinds else self._naming_cost)
            kinds.add(kind)
        total += sum(self._naming_cost + self._choice_costs[key][bits] for key, bits in numbers.items())
        return total - math.lgamma(len(kinds) + len(numbers) + 1)

    def _places_of(self, group: tuple[int, ...]) -> NDArray[np.intp]:
        """Return the columns of some candidates (p,)."""
        if group not in self._known_places:
            self._known_places[group] = np.concatenate([self._places[k] for k in group])
        return self._known_places[group]

    @cached_property
    def _choice_costs(self) -> dict[Key, FloatArray]:
        """Cost of each choice of numbers, for each cause that may have a subset of them [nats]."""
        in_parts = {effect.key: effect for effect in self.effects if effect.kind.in_parts}
        return {key: np.log(choice_counts(effect)) for key, effect in in_parts.items()}

    def _promising(self, current: CauseSet, least: float) -> list[tuple[int, ...]]:
        """Return the groups of candidates that may reach the net evidence `least`, the best first.

        Their worth is computed with scales and noise held fixed; with their own scales they may be worth more.
        """
        present = frozenset(current.chosen)
        closed = present | (self._begins if present & self._begins else set())
        groups = dict.fromkeys(tuple(k for k in group if k not in present) for group in self._groups)
        open_groups = [group for group in groups if group and closed.isdisjoint(group)]
        if not open_groups:
            return []
        places = self._places_of(tuple(sorted(frozenset[int]().union(*open_groups))))
        across = self._inner[np.ix_(current.columns, places)] / current.sigma**2
        solved = dpotrs(current.factor, across, lower=True)[0]
        inner = self._inner[np.ix_(places, places)] / current.sigma**2 - across.T @ solved
        gradient = self._rhs[places] / current.sigma**2 - solved.T @ (self._rhs[current.columns] / current.sigma**2)
        at = np.empty(len(self._rhs), dtype=np.intp)
        at[places] = np.arange(len(places))
        own = [at[self._places_of(group)] for group in open_groups]
        numbers, net_evidences = np.array([len(one) for one in own]), np.full(len(own), -np.inf)
        fixed = np.array([group[0] not in self._sized for group in open_groups])
        for log in SetSettings.log_sizes:
            narrow = inner + math.exp(-2.0 * log) * np.eye(len(inner))
            squares, volumes = _in_groups(narrow, gradient, own)
            net_evidence = squares - volumes - numbers * log - 0.5 * (log / BackgroundSettings.spread) ** 2
            net_evidences = np.where(fixed & (log != 0.0), net_evidences, np.maximum(net_evidences, net_evidence))
        net_evidences -= self._costs_of(current.chosen, open_groups, are_in=False)
        best = np.argsort(net_evidences)[::-1]
        return [
            open_groups[k]
            for k in best[current.net_evidence + net_evidences[best] > least - SetSettings.comes_near_nats].tolist()
        ]

    def _costs_of(self, chosen: Sequence[int], groups: Sequence[tuple[int, ...]], *, are_in: bool) -> FloatArray:
        """Return the cost of naming that each group contributes to a set, or would add to it [nats]."""
        kinds = Counter(self._kinds[k] for k in chosen if not self._kinds[k].in_parts)
        numbers: Counter[Key] = Counter()
        for k in chosen:
            if self._kinds[k].in_parts:
                numbers[self._keys[k]] += self._choice_bits[k]
        # Names are unordered: subtract the number of ways to write the same set.
        first = self._naming_cost - math.log(max(len(kinds) + len(numbers) + (not are_in), 1))
        costs = []
        for group in groups:
            kind, key = self._kinds[group[0]], self._keys[group[0]]
            if kind.in_parts:
                own = sum(self._choice_bits[k] for k in group)
                before = numbers[key] - (own if are_in else 0)
                of_numbers = self._choice_costs[key]
                costs.append(of_numbers[before + own] + (first if before == 0 else -of_numbers[before]))
            else:
                costs.append(self._trials[group[0]] + (WorthSettings.another_nats if kinds[kind] > are_in else first))
        return np.array(costs)

    def of(self, chosen: tuple[int, ...], near: CauseSet | None = None) -> CauseSet:
        """Fit the scales and the noise of a set of causes by maximum evidence; each set once, from any `near`."""
        key = frozenset(chosen)
        if key not in self._known:
            self._known[key] = self._fitted(chosen, near)
        return self._known[key]

    def _fitted(self, chosen: tuple[int, ...], near: CauseSet | None) -> CauseSet:
        own = [self._places[k] for k in chosen]
        columns = np.sort(np.concatenate([np.arange(self._nuisances + self._tolerances), *own]).astype(np.intp))
        group, most = self._group(columns, chosen)
        inner, rhs = self._inner[np.ix_(columns, columns)], self._rhs[columns]
        logs = np.minimum(np.append(np.log(near.scales if near else Scales()), np.zeros(len(most) - SCALES)), most)
        sigma = near.sigma if near else self._noise
        membership, effective_dof = (group == np.arange(len(most))[:, None]).astype(np.float64), np.zeros(len(most))
        unit = np.eye(len(columns), order="F")
        for done in range(SetSettings.rounds if near is None else SetSettings.rounds_near):
            factor, variances, amounts = solution = self._solved(inner, rhs, group, logs, sigma)
            inverse = dtrsm(1.0, factor, unit, lower=True)
            determined = 1.0 - np.einsum("ij,ij->j", inverse, inverse) / variances
            # Update from a scale's tolerances and its prior (MacKay 1992, equation 4.10).
            effective_dof, squares = membership @ determined, membership @ (np.square(amounts) / variances)
            variance = BackgroundSettings.spread**2
            steps = (squares - effective_dof - logs / variance) / (
                2.0 * np.maximum(effective_dof, 0.5) + 1.0 / variance
            )
            steps = np.minimum(np.maximum(steps, -SetSettings.farthest), SetSettings.farthest)
            moved = np.minimum(np.maximum(logs + steps, _LOG_MIN_SCALE), most)
            rss = self._square - 2.0 * float(amounts @ rhs) + float(amounts @ inner @ amounts)
            free = max(self._rows - float(determined.sum()), 1.0)
            log_noise_step = 0.5 * math.log(max(rss, 1e-300) / free) - math.log(sigma)
            log_noise_step = min(max(log_noise_step, -SetSettings.farthest), SetSettings.farthest)
            if done and max(np.abs(moved - logs).max(), abs(log_noise_step)) < SetSettings.still:
                break
            logs = moved
            sigma = max(sigma * math.exp(log_noise_step), SetSettings.quietest * self._noise)
        else:
            solution = self._solved(inner, rhs, group, logs, sigma)
        scales, sizes = Scales(*np.exp(logs[:SCALES]).tolist()), logs[SCALES:]
        net_evidence = self._evidence(solution, rhs, sigma) - scales.prior_penalty - _occam_cost(effective_dof[:SCALES])
        as_described = np.append(np.full(SCALES, _LOG_MIN_SCALE), sizes)
        exact = self._solved(inner, rhs, group, as_described, sigma)
        if (evidence := self._evidence(exact, rhs, sigma)) > net_evidence:
            scales = Scales(*[BackgroundSettings.smallest_scale] * SCALES)
            net_evidence, solution, logs = evidence, exact, as_described
        net_evidence -= 0.5 * float(np.square(sizes / BackgroundSettings.spread).sum()) + _occam_cost(
            effective_dof[SCALES:]
        )
        net_evidence += self._outliers - self._cost(chosen) - WorthSettings.named_nats * scales.excess_over_workshop
        factor, _, amounts = solution
        return CauseSet(
            chosen, net_evidence, scales, logs, group, sigma, effective_dof[:SCALES], amounts, factor, columns
        )

    def detected_scales(self, current: CauseSet) -> NDArray[np.bool_]:
        """Return True for each scale whose tolerances make the data much more probable (4,)."""
        whole = self._worth(current, current.logs)
        without = []
        for g in range(SCALES):
            logs = current.logs.copy()
            logs[g] = _LOG_MIN_SCALE
            without.append(self._worth(current, logs))
        return whole - np.array(without) > SetSettings.shown_nats

    def upper_limits(self, current: CauseSet) -> FloatArray:
        """Return the largest scale of each kind (4,) that the data do not rule out, given the others."""
        found = np.array(current.scales)
        for g in range(SCALES):
            logs, best = current.logs.copy(), -np.inf
            while logs[g] < _LOG_MAX_SCALE:
                net_evidence = self._worth(current, logs)
                best = max(best, net_evidence)
                if net_evidence < best - SetSettings.ruled_out_nats:
                    break
                logs[g] = min(logs[g] + SetSettings.finer, _LOG_MAX_SCALE)
            found[g] = np.exp(logs[g])
        return found

    def _group(self, columns: NDArray[np.intp], chosen: Sequence[int]) -> tuple[NDArray[np.int64], FloatArray]:
        """Return the index of each column's prior width (p,), -1 for a width of 1, and the largest logarithms of these.

        First come the scales of tolerances, then the sizes of poses.
        """
        group = np.full(len(columns), -1)
        group[self._nuisances : self._nuisances + self._tolerances] = self._of_scale
        sized = [k for k in chosen if k in self._sized]
        for index, k in enumerate(sized, SCALES):
            group[np.searchsorted(columns, self._places[k])] = index
        return group, np.append(np.full(SCALES, self._log_max_scale), np.full(len(sized), _LOG_MAX_SCALE))

    def _worth(self, current: CauseSet, logs: FloatArray) -> float:
        """Return the evidence of a set with other scales [nats]."""
        inner, rhs = self._inner[np.ix_(current.columns, current.columns)], self._rhs[current.columns]
        return self._evidence(self._solved(inner, rhs, current.group, logs, current.sigma), rhs, current.sigma)

    def _evidence(self, solution: _Solution, rhs: FloatArray, sigma: float) -> float:
        """Return the evidence of the scales and the noise of a solution [nats]."""
        factor, variances, amounts = solution
        left = self._square - float(amounts @ rhs)
        evidence = -0.5 * left / sigma**2 - self._rows * float(np.log(sigma))
        return evidence - float(np.log(factor.diagonal()).sum()) - 0.5 * float(np.log(variances).sum())

    def _solved(
        self, inner: FloatArray, rhs: FloatArray, group: np.ndarray, logs: FloatArray, sigma: float
    ) -> _Solution:
        """Return the factor of the precision, prior variances (p,) and amounts (p,), in units of `_units`."""
        # The last width stands for columns without one of their own.
        variances = np.append(np.exp(2.0 * logs), 1.0)[group]
        precision = inner / sigma**2
        diagonal = precision.reshape(-1)[:: len(precision) + 1]
        squares = diagonal.copy()
        diagonal += 1.0 / variances + SetSettings.rounded_off * squares
        factor, failed = dpotrf(precision, lower=True, clean=False)
        if failed:
            diagonal += SetSettings.one_beyond_rounding * squares
            factor = dpotrf(precision, lower=True, clean=False)[0]
        return factor, variances, dpotrs(factor, rhs / sigma**2, lower=True)[0]

    def causes(self, current: CauseSet) -> list[Effect]:
        found: dict[Identity, Effect] = {}
        for k in current.chosen:
            effect, places = self.effects[k], self._places[k]
            one = found.get(effect.identity, effect)
            free = None if effect.free is None else tuple(sorted({*effect.free, *(one.free or ())}))
            values = one.values.copy()
            values[effect.amounts] = current.amounts[np.searchsorted(current.columns, places)] * self._units[places]
            found[effect.identity] = replace(effect, free=free).with_values(values)
        return [cause.with_free_amounts(cause.free) for cause in found.values()]


def _usual_sizes(effects: Sequence[Effect]) -> FloatArray:
    """Return the usual sizes of the amounts of effects (p,)."""
    return np.array([effect.parameters[k].usual for effect in effects for k in effect.amounts])


def _columns(fit: Fit, effects: Sequence[Effect]) -> Iterator[FloatArray]:
    """Yield the weighted derivatives (n, 3, p) by the amounts of each effect."""
    key, columns = None, np.empty(0)
    for effect in effects:
        if effect.key != key:
            key, columns = effect.key, fit.weighted(fit.run.columns(effect))
        yield columns[:, :, effect.amounts]


def _parts(effect: Effect) -> list[tuple[object, ...]]:
    """Return the groups that contain one number of an effect: its shifts or its rotations, and all of it."""
    if not effect.kind.in_parts:
        return []
    unit = effect.parameters[effect.amounts[0]].name.rpartition("_")[2]
    return [(effect.key, unit), (effect.key,)]


def _occam_cost(effective_dof: FloatArray) -> float:
    """Return the cost [nats] of integrating over the scales instead of taking the best, from the data spent (4,)."""
    return float(0.5 * np.log1p(2.0 * effective_dof * BackgroundSettings.spread**2).sum())


def _in_groups(
    matrix: FloatArray, vector: FloatArray, groups: Sequence[NDArray[np.intp]]
) -> tuple[FloatArray, FloatArray]:
    """Return half of v' M⁻¹ v and of ln |M| for the part M, v of a matrix (p, p) and a vector (p,) in each group."""
    sizes, squares, volumes = np.array([len(group) for group in groups]), *np.empty((2, len(groups)))
    for size in np.unique(sizes).tolist():
        some = np.flatnonzero(sizes == size)
        places = np.stack([groups[k] for k in some.tolist()])
        if size == 1:
            alone = matrix.diagonal()[places[:, 0]]
            squares[some], volumes[some] = 0.5 * np.square(vector[places[:, 0]]) / alone, 0.5 * np.log(alone)
            continue
        matrices, vectors = matrix[places[:, :, None], places[:, None, :]], vector[places]
        squares[some] = 0.5 * (vectors * np.linalg.solve(matrices, vectors[:, :, None])[:, :, 0]).sum(axis=1)
        volumes[some] = 0.5 * np.linalg.slogdet(matrices)[1]
    return squares, volumes


def _without(chosen: tuple[int, ...], group: Sequence[int]) -> tuple[int, ...]:
    return tuple(k for k in chosen if k not in group)


def _better(tried: Sequence[CauseSet], current: CauseSet) -> CauseSet | None:
    best = max(tried, key=lambda one: one.net_evidence, default=None)
    return best if best is not None and best.net_evidence > current.net_evidence + SetSettings.still else None
