"""Fit unnamed families of linear functions that compete with the named effects.

So no effect is named if a different error is present.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from weakref import WeakKeyDictionary

import numpy as np
from scipy.special import chdtri

from bodyschema.diagnosis.fit.background import partially_weighted_rows
from bodyschema.diagnosis.fit.fit import Fit, solved
from bodyschema.diagnosis.fit.net_evidence import evidence_gain
from bodyschema.diagnosis.fit.noise import Noise
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.fit.tangent import TangentSettings
from bodyschema.diagnosis.search.held_out import Blocks, HeldOutSettings, held_out_square, scores_p_value
from bodyschema.interfaces.records import FloatArray

from .families import DiscrepancyFamily, families
from .low_rank import low_rank, numbers_of


class FamilySettings:
    """Settings of unnamed families.

    Sensitivity, each at 0.3 and 3 times over three recordings, one with a smooth unnamed error: `number` at 3 times
    and `no_worse` below 1 name wrong causes instead; `no_name` at 0.3 times and a single nearest family change what is
    rejected. The others change figures by 2 % at most; other `ranks` were not measured.
    """

    no_name, number = 8.0, 2.0  # prior penalty of a family that is less specific, and cost of one parameter [nats]
    identifiable = 1e-6  # share of the strongest direction below which one is not identifiable
    strongest = 4  # directions of a family that blocks of time have to agree on
    rounds, enough = 5, 0.1  # alternating rounds between families and causes, and the convergence limit [nats]
    ranks = (1, 2)  # motions of a body that share one or two functions
    no_worse = 1.02  # largest factor by which an unnamed family may worsen held-out errors
    nearest, near = 3, 0.9  # best families considered, and the share of the best first-order worth that they need
    specific_nats = 5.0  # prior penalty of a family as specific as a named effect [nats]


@dataclass(frozen=True, eq=False)
class PreparedFamily:
    """A family, or a part of one, prepared for fits of the same observations."""

    family: DiscrepancyFamily  # the family
    moved: FloatArray  # displacements (n, 3, m), whitened; many are scaled to about unit length, a single one is shared
    functions: FloatArray  # functions (n, a) of each motion, scaled so that their columns have about unit length
    scales: FloatArray  # lengths of the columns (p,): those of the motions times those of the functions
    choice: int = 0  # number of further parameters spent on choosing the part

    @classmethod
    def of(cls, family: DiscrepancyFamily, start: Fit, moved: FloatArray | None = None) -> PreparedFamily:
        """Prepare the whole family; its displacements `moved` may be given."""
        functions = family.functions(start.run)
        moved = start.observations.whitened(family.moved(start.run)) if moved is None else moved
        # Lengths (m, a) of the columns, which are products of motions and functions.
        lengths = np.sqrt(np.square(moved).sum(axis=1).T @ np.square(functions))
        of_moves = np.maximum(np.sqrt(np.square(lengths).mean(axis=1, keepdims=True)), 1e-100)
        of_functions = np.maximum(np.sqrt(np.square(lengths / of_moves).mean(axis=0)), 1e-100)
        scales = of_moves * of_functions
        if len(of_moves) == 1:
            return cls(family, moved, functions / scales, scales.ravel())
        return cls(family, moved / of_moves[:, 0], functions / of_functions, scales.ravel())

    @property
    def columns(self) -> FloatArray:
        """Columns (3 n, p) of its parameters, computed on demand to save memory."""
        columns = self.moved[:, :, :, None] * self.functions[:, None, None, :]
        return columns.reshape(3 * len(self.moved), self.moves * self.amounts)

    @cached_property
    def _inner(self) -> FloatArray:
        return self._products(np.ones(len(self.moved)))

    def inner(self, weights: FloatArray) -> FloatArray:
        """Return the products (p, p) of the columns, rows weighted (n,)."""
        partly = partially_weighted_rows(weights)
        if not len(partly):
            return self._inner
        some = replace(self, moved=self.moved[partly], functions=self.functions[partly])
        return self._inner - some._products(1.0 - weights[partly])

    def _products(self, weights: FloatArray) -> FloatArray:
        """Return the products (p, p) of the columns, without forming them."""
        along = np.swapaxes(self.moved, 1, 2) @ (self.moved * weights[:, None, None])
        products = np.empty((self.moves, self.amounts, self.moves, self.amounts))
        for one, other in combinations_with_replacement(range(self.moves), 2):
            both = self.functions.T @ (along[:, one, other, None] * self.functions)
            products[one, :, other], products[other, :, one] = both, both
        return products.reshape(len(self.scales), -1)

    def rhs(self, others: FloatArray, along: FloatArray | None) -> FloatArray:
        """Return the products (p, r) of the columns with others (n, 3, r).

        Args:
            along: products of `moved` with the others (n, m, r), row by row; not needed for one function per motion.
        """
        if along is None:
            return self.columns.T @ others.reshape(3 * len(others), -1)
        products = self.functions.T @ along.reshape(len(along), -1)
        return np.swapaxes(products.reshape(self.amounts, self.moves, -1), 0, 1).reshape(len(self.scales), -1)

    @property
    def moves(self) -> int:
        return self.moved.shape[2]

    @property
    def amounts(self) -> int:
        """Number of functions of each motion."""
        return self.functions.shape[1]

    def along(self, functions: FloatArray) -> PreparedFamily:
        """Return the part whose motions follow given functions (b, r), in units of the scales."""
        rank = functions.shape[1]
        scales = self.scales.reshape(self.moves, self.amounts)
        mix = functions / (scales[0] / scales[0].max())[:, None]
        of_moves = np.repeat(scales[:, scales[0].argmax()], rank)
        choice = numbers_of(self.moves, self.amounts, rank) - len(of_moves)
        return PreparedFamily(self.family.along(mix), self.moved, self.functions @ functions, of_moves, choice)


@dataclass(frozen=True, eq=False)
class FitWithDiscrepancy:
    """A fit of the causes to the observations after removing the unnamed errors."""

    observations: Observations  # the complete observations
    chosen: tuple[PreparedFamily, ...]  # the unnamed families
    numbers: tuple[FloatArray, ...]  # parameters of each of them (p,)
    fit: Fit  # the fit of the causes
    precision: float  # prior precision of these parameters, in units in which their columns have unit length

    @property
    def predicted(self) -> FloatArray:
        """Predicted measurements (n, 3) [m] by causes and families together."""
        return self.fit.predicted + (self.observations.x - self.fit.observations.x)

    @property
    def choice(self) -> int:
        """Number of additional parameters spent on the choice of parts of families."""
        return sum(prepared.choice for prepared in self.chosen)


class UnnamedFamilies:
    """All unnamed families, prepared for fits of the same observations.

    Their columns are those of the aligned simulation, since unnamed errors and changes by the causes are small.
    """

    def __init__(self, start: Fit) -> None:
        self._start, self._run = start, start.run
        self._families = families(start.run)
        self._prepared: dict[int, PreparedFamily] = {}
        # By the noise of a fit, which copies of the fit share.
        self._near: WeakKeyDictionary[
            Noise, dict[tuple[float | PreparedFamily, ...], list[tuple[PreparedFamily, float]]]
        ] = WeakKeyDictionary()
        self._discrepancy_fits: WeakKeyDictionary[Noise, dict[tuple[PreparedFamily, ...], FitWithDiscrepancy]] = (
            WeakKeyDictionary()
        )

    def _prepared_family(self, k: int) -> PreparedFamily:
        if k not in self._prepared:
            family = self._families[k]
            joint = family.joint if family.kind == "joint" else None
            self._prepared[k] = PreparedFamily.of(family, self._start, None if joint is None else self._by_joint[joint])
        return self._prepared[k]

    @cached_property
    def _by_joint(self) -> list[FloatArray]:
        """Displacements (n, 3, 1) by each joint, whitened."""
        moved = self._start.observations.whitened(self._run.by_joint)
        return [moved[:, :, [k]] for k in range(moved.shape[2])]

    @property
    def count(self) -> int:
        return len(self._families)

    def again(self, found: Sequence[PreparedFamily]) -> tuple[PreparedFamily, ...]:
        """Return the same families, or parts of them, that were found in other observations."""
        return tuple(
            replace(PreparedFamily.of(prepared.family, self._start), choice=prepared.choice) for prepared in found
        )

    def basis_and_residuals(self, fit: Fit, others: Sequence[PreparedFamily] = ()) -> tuple[FloatArray, FloatArray]:
        """Return an orthonormal basis (3 n, r) of the changes by `fit` and some families, and the residuals (3 n,)."""
        basis = basis_of(fit)
        for prepared in others:
            basis = np.concatenate([basis, self._added_directions(fit, basis, prepared)], axis=1)
        left = fit.whitened_residuals.ravel()
        return basis, left - basis @ (basis.T @ left)

    def nearest(
        self, fit: Fit, others: Sequence[PreparedFamily] = (), independence: float = 1.0
    ) -> list[tuple[PreparedFamily, float]]:
        """Return the families that may be best beside a fit and others, with their first-order worth [nats].

        Args:
            independence: effective number of independent rows per row.
        """
        known = self._near.setdefault(fit.noise, {})
        if (independence, *others) not in known:
            known[independence, *others] = self._ranked(fit, others, independence)
        return known[independence, *others]

    def _ranked(
        self, fit: Fit, others: Sequence[PreparedFamily], independence: float
    ) -> list[tuple[PreparedFamily, float]]:
        basis, left = self.basis_and_residuals(fit, others)
        rss, rows = float(left @ left), independence * float(fit.noise.weights.sum())
        directions, shares = fit.absorbed_directions
        free = 3.0 * float(fit.noise.weights.sum()) - basis.shape[1]
        twice = np.column_stack([directions * np.sqrt(shares), fit.fully_whitened(np.column_stack([basis, left]))])
        seen = twice.reshape(*fit.weighted_residuals.shape, -1) * fit.root_weights[:, :, None]
        ranked: list[tuple[float, PreparedFamily, FloatArray | None]] = []
        moved, along = np.empty(0), np.empty(0)
        for prepared in map(self._prepared_family, range(self.count)):
            if prepared in others:
                continue
            if prepared.moved is not moved and prepared.amounts > 1:
                moved, along = prepared.moved, np.swapaxes(prepared.moved, 1, 2) @ seen
            products = prepared.rhs(seen, along if prepared.moved is moved else None)
            projections, rhs = products[:, :-1], products[:, -1]
            inner = prepared.inner(fit.noise.weights) - projections @ projections.T
            values, vectors = np.linalg.eigh(inner)
            identifiable = values > FamilySettings.identifiable * max(float(values.max()), 1e-12)
            identifiable &= values > TangentSettings.told_apart
            explained = float(np.square(vectors[:, identifiable].T @ rhs / np.sqrt(values[identifiable])).sum())
            most, numbers = (
                _log_likelihood_rise(explained, rss, rows) - self._prior_penalty_of(prepared),
                int(identifiable.sum()),
            )
            if numbers >= free:
                # As many numbers as residuals leave no noise.
                most = -np.inf
            ranked.append((most - FamilySettings.number * numbers, prepared, None))
            for rank in (rank for rank in FamilySettings.ranks if rank < min(prepared.moves, prepared.amounts)):
                fewer = numbers_of(prepared.moves, prepared.amounts, rank)
                best = FamilySettings.near * max(net_evidence for net_evidence, _, _ in ranked)
                # A part explains no more than the whole.
                if fewer < numbers and most - FamilySettings.number * fewer > max(best, 0.0):
                    explained, functions = low_rank(inner, rhs, prepared.amounts, rank)
                    net_evidence = (
                        _log_likelihood_rise(explained, rss, rows)
                        - self._prior_penalty_of(prepared)
                        - FamilySettings.number * fewer
                    )
                    ranked.append((net_evidence, prepared, functions))
        ranked.sort(key=lambda one: -one[0])
        ranked = [
            one
            for one in ranked[: FamilySettings.nearest]
            if one[0] > FamilySettings.near * ranked[0][0] or one is ranked[0]
        ]
        return [
            (prepared if part is None else prepared.along(part), net_evidence)
            for net_evidence, prepared, part in ranked
        ]

    def specific(self, fit: Fit, least: float) -> list[PreparedFamily]:
        """Return the families as specific as a named effect that explain most beside a fit, the best first.

        Args:
            least: smallest first-order Δχ².
        """
        basis, left = basis_of(fit), fit.whitened_residuals.ravel() / fit.noise.sigma
        ranked = [
            (float(np.square(self._added_directions(fit, basis, self._prepared_family(k)).T @ left).sum()), k)
            for k, family in enumerate(self._families)
            if family.is_specific
        ]
        return [
            self._prepared_family(k)
            for gain, k in sorted(ranked, reverse=True)[: FamilySettings.nearest]
            if gain >= least
        ]

    def _prior_penalty_of(self, prepared: PreparedFamily) -> float:
        """Return the multiplicity and prior penalty of a family [nats]."""
        own = FamilySettings.specific_nats if prepared.family.is_specific else FamilySettings.no_name
        return float(np.log(self.count)) + own

    def discrepancy_fit(
        self, fit: Fit, chosen: Sequence[PreparedFamily], start: FitWithDiscrepancy | None = None
    ) -> FitWithDiscrepancy:
        """Fit the causes and unnamed families alternately, each to the residuals of the other.

        An error of a joint is applied to its readings, so that large errors are exact too.

        Args:
            start: a fit with some of the families.
        """
        done = self._discrepancy_fits.setdefault(fit.noise, {})
        if tuple(chosen) not in done:
            done[tuple(chosen)] = self._fit_discrepancies(fit, chosen, start)
        return done[tuple(chosen)]

    def _fit_discrepancies(
        self, fit: Fit, chosen: Sequence[PreparedFamily], start: FitWithDiscrepancy | None
    ) -> FitWithDiscrepancy:
        known = {} if start is None else dict(zip(start.chosen, start.numbers, strict=True))
        numbers = tuple(known.get(prepared, np.zeros(len(prepared.scales))) for prepared in chosen)
        # No function is expected to exceed twice the whole residual.
        precision = 0.25 / max(float(np.square(fit.weighted_residuals).sum()), 1e-300)
        here = FitWithDiscrepancy(
            fit.observations, tuple(chosen), numbers, fit if start is None else start.fit, precision
        )
        for _ in range(FamilySettings.rounds):
            numbers = self._step(here)
            left = self._without(fit.observations, chosen, numbers)
            tried = here.fit.to(left)
            rise = tried.log_likelihood - here.fit.log_likelihood
            if rise > 0.0:
                here = replace(here, numbers=numbers, fit=tried)
            if rise < FamilySettings.enough:
                break
        return here

    def cost(self, discrepancy_fit: FitWithDiscrepancy) -> float:
        """Return the cost of the families and their parameters [nats]."""
        numbers = self._identifiable_mixtures(discrepancy_fit)[0].shape[0] + discrepancy_fit.choice
        return (
            sum(self._prior_penalty_of(prepared) for prepared in discrepancy_fit.chosen)
            + FamilySettings.number * numbers
        )

    def identifiable_directions(self, discrepancy_fit: FitWithDiscrepancy) -> FloatArray:
        """Return the identifiable directions (n, 3, r) [m] that families change beside the causes."""
        fit = discrepancy_fit.fit
        values, mix = self._identifiable_mixtures(discrepancy_fit)
        columns = np.concatenate([prepared.columns for prepared in discrepancy_fit.chosen], axis=1)
        directions = (columns @ (mix / np.sqrt(values))).reshape(*fit.weighted_residuals.shape, -1)
        return np.asarray(np.linalg.solve(fit.observations.whitening, directions), dtype=np.float64)

    def _identifiable_mixtures(self, discrepancy_fit: FitWithDiscrepancy) -> tuple[FloatArray, FloatArray]:
        """Return squared lengths (r,) of the changes beside the causes, and their mixtures of parameters (p, r)."""
        fit = discrepancy_fit.fit
        basis = basis_of(fit)
        return _directions(
            np.concatenate([prepared.columns for prepared in discrepancy_fit.chosen], axis=1), fit, basis
        )[1:]

    def predicts(self, discrepancy_fit: FitWithDiscrepancy, alone: Fit) -> bool:
        """Return True if unnamed families predict held-out rows as well as a fit without them."""
        rows = len(alone.observations)
        # Functions of time cannot be extrapolated over long blocks.
        timed = any(prepared.family.over_time for prepared in discrepancy_fit.chosen)
        blocks = Blocks.cut(rows, rows // HeldOutSettings.min_rows_a_block) if timed else Blocks.cut(rows)
        return self._missed(discrepancy_fit.fit, blocks, discrepancy_fit) <= FamilySettings.no_worse * self._missed(
            alone, blocks
        )

    def _missed(self, fit: Fit, blocks: Blocks, discrepancy_fit: FitWithDiscrepancy | None = None) -> float:
        """Return the mean squared residual of causes and families on held-out rows, whitened."""
        columns, precision = fit.columns, fit.precision
        if discrepancy_fit is not None:
            # Apply the prior of the fit to each parameter, so that few rows are not extrapolated.
            more = [
                prepared.columns.reshape(*fit.weighted_residuals.shape, -1) * fit.root_weights[:, :, None]
                for prepared in discrepancy_fit.chosen
            ]
            more = np.concatenate(more, axis=2)
            columns = np.concatenate([columns, more], axis=2)
            precision = np.append(precision, np.full(more.shape[2], discrepancy_fit.precision))
        square = held_out_square(fit, columns, precision, blocks)
        return square / max(float(fit.noise.weights.sum()), 1.0)

    def _step(self, here: FitWithDiscrepancy) -> tuple[FloatArray, ...]:
        """Return the parameters of families that best explain the residuals of the causes, under their prior."""
        fit, counts = here.fit, [len(number) for number in here.numbers]
        basis = basis_of(fit)
        weights = np.repeat(fit.root_weights[:, 0], 3)[:, None]
        columns = fit.fully_whitened(np.concatenate([prepared.columns for prepared in here.chosen], axis=1) * weights)
        columns = columns - basis @ (basis.T @ columns)
        scales = np.concatenate([prepared.scales for prepared in here.chosen])
        before = np.concatenate(here.numbers) * scales
        ridge = here.precision * fit.noise.sigma**2
        normal = columns.T @ columns + ridge * np.eye(len(before))
        step = solved(normal, columns.T @ fit.whitened_residuals.ravel() - ridge * before)
        return tuple(np.split((before + step) / scales, np.cumsum(counts)[:-1]))

    def _without(
        self, observations: Observations, chosen: Sequence[PreparedFamily], numbers: Sequence[FloatArray]
    ) -> Observations:
        """Remove the families' part: a joint's error and lateness from the readings, others from the positions."""
        q, x = observations.motion.q.copy(), observations.x.copy()
        for family, own in ((prepared.family, own) for prepared, own in zip(chosen, numbers, strict=True)):
            if family.kind == "joint":
                q[:, family.joint] += family.moved_by(self._run, own)[:, 0]
            elif family.kind == "clock":
                motion = observations.motion
                q += motion.earlier(family.moved_by(self._run, own)[:, 0]).q - motion.q
            elif family.correct is not None:
                x = family.correct(x, own)
            else:
                x -= family.columns(self._run) @ own
        return replace(observations, motion=replace(observations.motion, q=q), x=x)

    def evidence_from_blocks(self, fit: Fit, others: Sequence[PreparedFamily], prepared: PreparedFamily) -> float:
        """Return the net evidence of a family by the agreement of blocks of time [nats]."""
        basis, left = self.basis_and_residuals(fit, others)
        fresh = self._added_directions(fit, basis, prepared)
        strongest = np.argsort(-np.abs(fresh.T @ left))[: FamilySettings.strongest]
        columns = fresh[:, strongest].reshape(*fit.weighted_residuals.shape, -1)
        chance = scores_p_value(
            columns, left.reshape(fit.weighted_residuals.shape), Blocks.cut(len(fit.weighted_residuals))
        )
        # The strongest directions were selected; each costs one choice among all.
        gain = float(chdtri(len(strongest), max(chance, 1e-290)))
        choice = len(strongest) * float(np.log(fresh.shape[1])) + FamilySettings.number * prepared.choice
        return evidence_gain(gain, len(strongest)) - choice - self._prior_penalty_of(prepared)

    def _added_directions(self, fit: Fit, basis: FloatArray, prepared: PreparedFamily) -> FloatArray:
        """Return an orthonormal basis (3 n, r) of the changes by a family beside a basis."""
        columns, values, mix = _directions(prepared.columns, fit, basis)
        return columns @ (mix / np.sqrt(values))


def basis_of(fit: Fit) -> FloatArray:
    """Return an orthonormal basis (3 n, r) of the changes by the amounts of a fit."""
    return fit.effect_basis.reshape(fit.weighted_residuals.size, -1)


def _directions(columns: FloatArray, fit: Fit, basis: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return weighted columns (3 n, p) beside a basis, and identifiable squared lengths (r,) and mixtures (p, r)."""
    weighted = fit.fully_whitened(columns * np.repeat(fit.root_weights[:, 0], 3)[:, None])
    weighted = weighted - basis @ (basis.T @ weighted)
    values, vectors = np.linalg.eigh(weighted.T @ weighted)
    there = values > TangentSettings.told_apart
    return weighted, values[there], vectors[:, there]


def _log_likelihood_rise(explained: float, rss: float, rows: float) -> float:
    """Return the rise of the log-likelihood when part of a sum of squares is explained [nats]."""
    return -1.5 * rows * float(np.log1p(-min(explained / max(rss, 1e-300), 0.999999)))
