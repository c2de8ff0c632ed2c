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

from bodyschema.diagnosis.fit.background import rows_in_part
from bodyschema.diagnosis.fit.fit import Fit, solved
from bodyschema.diagnosis.fit.noise import Noise
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.fit.tangent import TangentSettings
from bodyschema.diagnosis.fit.worth import nats
from bodyschema.diagnosis.search.held_out import Blocks, HeldOutSettings, held_out_square, scores_p_value
from bodyschema.interfaces.records import FloatArray

from .families import Family, families
from .low_rank import low_rank, numbers_of


class FamilySettings:
    """Settings of unnamed families.

    Sensitivity, each at 0.3 and 3 times over three recordings, one with a smooth unnamed error: `number` at 3 times
    and `no_worse` below 1 name wrong causes instead; `no_name` at 0.3 times and a single nearest family change what is
    rejected. The others change figures by 2 % at most; other `ranks` were not measured.
    """

    no_name, number = 8.0, 2.0  # prior penalty of a family that is less specific, and cost of one parameter [nats]
    told = 1e-6  # share of the strongest direction below which one is not identifiable
    strongest = 4  # directions of a family that blocks of time have to agree on
    rounds, enough = 5, 0.1  # alternating rounds between families and causes, and the convergence limit [nats]
    ranks = (1, 2)  # motions of a body that share one or two functions
    no_worse = 1.02  # largest factor by which an unnamed family may worsen held-out errors
    nearest, near = 3, 0.9  # best families considered, and the share of the best first-order worth that they need
    specific_nats = 5.0  # prior penalty of a family as specific as a named effect [nats]


@dataclass(frozen=True, eq=False)
class Way:
    """A family, or a part of one, prepared for fits of the same observations."""

    family: Family  # the family
    moved: FloatArray  # displacements (n, 3, m), whitened; many are scaled to about unit length, a single one is shared
    functions: FloatArray  # functions (n, a) of each motion, scaled so that their columns have about unit length
    scales: FloatArray  # lengths of the columns (p,): those of the motions times those of the functions
    choice: int = 0  # number of further parameters spent on choosing the part

    @classmethod
    def of(cls, family: Family, start: Fit, moved: FloatArray | None = None) -> Way:
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
        partly = rows_in_part(weights)
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

    def toward(self, others: FloatArray, along: FloatArray | None) -> FloatArray:
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

    def along(self, functions: FloatArray) -> Way:
        """Return the part whose motions follow given functions (b, r), in units of the scales."""
        rank = functions.shape[1]
        scales = self.scales.reshape(self.moves, self.amounts)
        mix = functions / (scales[0] / scales[0].max())[:, None]
        of_moves = np.repeat(scales[:, scales[0].argmax()], rank)
        choice = numbers_of(self.moves, self.amounts, rank) - len(of_moves)
        return Way(self.family.along(mix), self.moved, self.functions @ functions, of_moves, choice)


@dataclass(frozen=True, eq=False)
class Apart:
    """A fit of the causes to the observations after removing the unnamed errors."""

    observations: Observations  # the complete observations
    chosen: tuple[Way, ...]  # the unnamed families
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
        return sum(way.choice for way in self.chosen)


class UnnamedFamilies:
    """All unnamed families, prepared for fits of the same observations.

    Their columns are those of the aligned simulation, since unnamed errors and changes by the causes are small.
    """

    def __init__(self, start: Fit) -> None:
        self._start, self._run = start, start.run
        self._families = families(start.run)
        self._prepared: dict[int, Way] = {}
        # By the noise of a fit, which copies of the fit share.
        self._near: WeakKeyDictionary[Noise, dict[tuple[float | Way, ...], list[tuple[Way, float]]]] = (
            WeakKeyDictionary()
        )
        self._apart: WeakKeyDictionary[Noise, dict[tuple[Way, ...], Apart]] = WeakKeyDictionary()

    def _way(self, k: int) -> Way:
        if k not in self._prepared:
            family = self._families[k]
            joint = family.joint if family.kind == "joint" else None
            self._prepared[k] = Way.of(family, self._start, None if joint is None else self._by_joint[joint])
        return self._prepared[k]

    @cached_property
    def _by_joint(self) -> list[FloatArray]:
        """Displacements (n, 3, 1) by each joint, whitened."""
        moved = self._start.observations.whitened(self._run.by_joint)
        return [moved[:, :, [k]] for k in range(moved.shape[2])]

    @property
    def count(self) -> int:
        return len(self._families)

    def again(self, ways: Sequence[Way]) -> tuple[Way, ...]:
        """Return the same families, or parts of them, that were found in other observations."""
        return tuple(replace(Way.of(way.family, self._start), choice=way.choice) for way in ways)

    def beside(self, fit: Fit, others: Sequence[Way] = ()) -> tuple[FloatArray, FloatArray]:
        """Return an orthonormal basis (3 n, r) of the changes by `fit` and some families, and the residuals (3 n,)."""
        basis = basis_of(fit)
        for way in others:
            basis = np.concatenate([basis, self._fresh(fit, basis, way)], axis=1)
        left = fit.evident.ravel()
        return basis, left - basis @ (basis.T @ left)

    def nearest(self, fit: Fit, others: Sequence[Way] = (), counted: float = 1.0) -> list[tuple[Way, float]]:
        """Return the families that may be best beside a fit and others, with their first-order worth [nats].

        Args:
            counted: effective number of independent rows per row.
        """
        known = self._near.setdefault(fit.noise, {})
        if (counted, *others) not in known:
            known[counted, *others] = self._ranked(fit, others, counted)
        return known[counted, *others]

    def _ranked(self, fit: Fit, others: Sequence[Way], counted: float) -> list[tuple[Way, float]]:
        basis, left = self.beside(fit, others)
        rss, rows = float(left @ left), counted * float(fit.noise.weights.sum())
        directions, shares = fit.absorbed
        free = 3.0 * float(fit.noise.weights.sum()) - basis.shape[1]
        twice = np.column_stack([directions * np.sqrt(shares), fit.unshared(np.column_stack([basis, left]))])
        seen = twice.reshape(*fit.left.shape, -1) * fit.root_weights[:, :, None]
        ranked: list[tuple[float, Way, FloatArray | None]] = []
        moved, along = np.empty(0), np.empty(0)
        for way in map(self._way, range(self.count)):
            if way in others:
                continue
            if way.moved is not moved and way.amounts > 1:
                moved, along = way.moved, np.swapaxes(way.moved, 1, 2) @ seen
            products = way.toward(seen, along if way.moved is moved else None)
            onto, toward = products[:, :-1], products[:, -1]
            inner = way.inner(fit.noise.weights) - onto @ onto.T
            values, vectors = np.linalg.eigh(inner)
            told = values > FamilySettings.told * max(float(values.max()), 1e-12)
            told &= values > TangentSettings.told_apart
            explained = float(np.square(vectors[:, told].T @ toward / np.sqrt(values[told])).sum())
            most, numbers = _nats(explained, rss, rows) - self._doubt_of(way), int(told.sum())
            if numbers >= free:
                # As many numbers as residuals leave no noise.
                most = -np.inf
            ranked.append((most - FamilySettings.number * numbers, way, None))
            for rank in (rank for rank in FamilySettings.ranks if rank < min(way.moves, way.amounts)):
                fewer = numbers_of(way.moves, way.amounts, rank)
                best = FamilySettings.near * max(worth for worth, _, _ in ranked)
                # A part explains no more than the whole.
                if fewer < numbers and most - FamilySettings.number * fewer > max(best, 0.0):
                    explained, functions = low_rank(inner, toward, way.amounts, rank)
                    worth = _nats(explained, rss, rows) - self._doubt_of(way) - FamilySettings.number * fewer
                    ranked.append((worth, way, functions))
        ranked.sort(key=lambda one: -one[0])
        ranked = [
            one
            for one in ranked[: FamilySettings.nearest]
            if one[0] > FamilySettings.near * ranked[0][0] or one is ranked[0]
        ]
        return [(way if part is None else way.along(part), worth) for worth, way, part in ranked]

    def specific(self, fit: Fit, least: float) -> list[Way]:
        """Return the families as specific as a named effect that explain most beside a fit, the best first.

        Args:
            least: smallest first-order Δχ².
        """
        basis, left = basis_of(fit), fit.evident.ravel() / fit.noise.sigma
        ranked = [
            (float(np.square(self._fresh(fit, basis, self._way(k)).T @ left).sum()), k)
            for k, family in enumerate(self._families)
            if family.is_specific
        ]
        return [self._way(k) for gain, k in sorted(ranked, reverse=True)[: FamilySettings.nearest] if gain >= least]

    def _doubt_of(self, way: Way) -> float:
        """Return the multiplicity and prior penalty of a family [nats]."""
        own = FamilySettings.specific_nats if way.family.is_specific else FamilySettings.no_name
        return float(np.log(self.count)) + own

    def apart(self, fit: Fit, chosen: Sequence[Way], start: Apart | None = None) -> Apart:
        """Fit the causes and unnamed families alternately, each to the residuals of the other.

        An error of a joint is applied to its readings, so that large errors are exact too.

        Args:
            start: a fit with some of the families.
        """
        done = self._apart.setdefault(fit.noise, {})
        if tuple(chosen) not in done:
            done[tuple(chosen)] = self._fitted_apart(fit, chosen, start)
        return done[tuple(chosen)]

    def _fitted_apart(self, fit: Fit, chosen: Sequence[Way], start: Apart | None) -> Apart:
        known = {} if start is None else dict(zip(start.chosen, start.numbers, strict=True))
        numbers = tuple(known.get(way, np.zeros(len(way.scales))) for way in chosen)
        # No function is expected to exceed twice the whole residual.
        precision = 0.25 / max(float(np.square(fit.left).sum()), 1e-300)
        here = Apart(fit.observations, tuple(chosen), numbers, fit if start is None else start.fit, precision)
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

    def cost(self, apart: Apart) -> float:
        """Return the cost of the families and their parameters [nats]."""
        numbers = self._beside(apart)[0].shape[0] + apart.choice
        return sum(self._doubt_of(way) for way in apart.chosen) + FamilySettings.number * numbers

    def told(self, apart: Apart) -> FloatArray:
        """Return the identifiable directions (n, 3, r) [m] that families change beside the causes."""
        fit = apart.fit
        values, mix = self._beside(apart)
        columns = np.concatenate([way.columns for way in apart.chosen], axis=1)
        directions = (columns @ (mix / np.sqrt(values))).reshape(*fit.left.shape, -1)
        return np.asarray(np.linalg.solve(fit.observations.whitening, directions), dtype=np.float64)

    def _beside(self, apart: Apart) -> tuple[FloatArray, FloatArray]:
        """Return squared lengths (r,) of the changes beside the causes, and their mixtures of parameters (p, r)."""
        fit = apart.fit
        basis = basis_of(fit)
        return _directions(np.concatenate([way.columns for way in apart.chosen], axis=1), fit, basis)[1:]

    def predicts(self, apart: Apart, alone: Fit) -> bool:
        """Return True if unnamed families predict held-out rows as well as a fit without them."""
        rows = len(alone.observations)
        # Functions of time cannot be extrapolated over long blocks.
        timed = any(way.family.over_time for way in apart.chosen)
        blocks = Blocks.cut(rows, rows // HeldOutSettings.fewest_rows_a_block) if timed else Blocks.cut(rows)
        return self._missed(apart.fit, blocks, apart) <= FamilySettings.no_worse * self._missed(alone, blocks)

    def _missed(self, fit: Fit, blocks: Blocks, apart: Apart | None = None) -> float:
        """Return the mean squared residual of causes and families on held-out rows, whitened."""
        columns, precision = fit.columns, fit.precision
        if apart is not None:
            # Apply the prior of the fit to each parameter, so that few rows are not extrapolated.
            more = [way.columns.reshape(*fit.left.shape, -1) * fit.root_weights[:, :, None] for way in apart.chosen]
            more = np.concatenate(more, axis=2)
            columns = np.concatenate([columns, more], axis=2)
            precision = np.append(precision, np.full(more.shape[2], apart.precision))
        square = held_out_square(fit, columns, precision, blocks)
        return square / max(float(fit.noise.weights.sum()), 1.0)

    def _step(self, here: Apart) -> tuple[FloatArray, ...]:
        """Return the parameters of families that best explain the residuals of the causes, under their prior."""
        fit, counts = here.fit, [len(number) for number in here.numbers]
        basis = basis_of(fit)
        weights = np.repeat(fit.root_weights[:, 0], 3)[:, None]
        columns = fit.unshared(np.concatenate([way.columns for way in here.chosen], axis=1) * weights)
        columns = columns - basis @ (basis.T @ columns)
        scales = np.concatenate([way.scales for way in here.chosen])
        before = np.concatenate(here.numbers) * scales
        ridge = here.precision * fit.noise.sigma**2
        normal = columns.T @ columns + ridge * np.eye(len(before))
        step = solved(normal, columns.T @ fit.evident.ravel() - ridge * before)
        return tuple(np.split((before + step) / scales, np.cumsum(counts)[:-1]))

    def _without(
        self, observations: Observations, chosen: Sequence[Way], numbers: Sequence[FloatArray]
    ) -> Observations:
        """Remove the families' part: a joint's error and lateness from the readings, others from the positions."""
        q, x = observations.motion.q.copy(), observations.x.copy()
        for family, own in ((way.family, own) for way, own in zip(chosen, numbers, strict=True)):
            if family.kind == "joint":
                q[:, family.joint] += family.moved_by(self._run, own)[:, 0]
            elif family.kind == "clock":
                motion = observations.motion
                q += motion.earlier(family.moved_by(self._run, own)[:, 0]).q - motion.q
            elif family.undone is not None:
                x = family.undone(x, own)
            else:
                x -= family.columns(self._run) @ own
        return replace(observations, motion=replace(observations.motion, q=q), x=x)

    def agreed(self, fit: Fit, others: Sequence[Way], way: Way) -> float:
        """Return the worth of a family by the agreement of blocks of time [nats]."""
        basis, left = self.beside(fit, others)
        fresh = self._fresh(fit, basis, way)
        strongest = np.argsort(-np.abs(fresh.T @ left))[: FamilySettings.strongest]
        columns = fresh[:, strongest].reshape(*fit.left.shape, -1)
        chance = scores_p_value(columns, left.reshape(fit.left.shape), Blocks.cut(len(fit.left)))
        # The strongest directions were selected; each costs one choice among all.
        gain = float(chdtri(len(strongest), max(chance, 1e-290)))
        choice = len(strongest) * float(np.log(fresh.shape[1])) + FamilySettings.number * way.choice
        return nats(gain, len(strongest)) - choice - self._doubt_of(way)

    def _fresh(self, fit: Fit, basis: FloatArray, way: Way) -> FloatArray:
        """Return an orthonormal basis (3 n, r) of the changes by a family beside a basis."""
        columns, values, mix = _directions(way.columns, fit, basis)
        return columns @ (mix / np.sqrt(values))


def basis_of(fit: Fit) -> FloatArray:
    """Return an orthonormal basis (3 n, r) of the changes by the amounts of a fit."""
    return fit.orthogonal.reshape(fit.left.size, -1)


def _directions(columns: FloatArray, fit: Fit, basis: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return weighted columns (3 n, p) beside a basis, and identifiable squared lengths (r,) and mixtures (p, r)."""
    weighted = fit.unshared(columns * np.repeat(fit.root_weights[:, 0], 3)[:, None])
    weighted = weighted - basis @ (basis.T @ weighted)
    values, vectors = np.linalg.eigh(weighted.T @ weighted)
    there = values > TangentSettings.told_apart
    return weighted, values[there], vectors[:, there]


def _nats(explained: float, rss: float, rows: float) -> float:
    """Return the rise of the log-likelihood when part of a sum of squares is explained [nats]."""
    return -1.5 * rows * float(np.log1p(-min(explained / max(rss, 1e-300), 0.999999)))
