"""A smooth model of what has no name: by how much of each function, and what can be stored of it.

What is fitted are the functions of the families that were found, together with the causes' numbers. Those that depend
on the readings alone become a KB-Map; what changes with time cannot be one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np

from effects import Motion, Simulated, Simulation, Unexplained, place_map, smooth_map
from interfaces.records import FloatArray

from .fit import Fit, fitted, prior_precision, solved
from .held_out import Blocks
from .unknown import TIME, Family

# How far a function may move the marker anywhere, in units of the noise; what predicts rows best is taken.
_SIZES = (3.0, 10.0, 30.0, 100.0, 300.0)
_WIDE = 400
# Harmonics of one joint's angle beyond those by which a family was found.
_FINER = (6, 14)
# What is left out of a stored model, of the noise.
_LEFT_OUT = 0.02


@dataclass(frozen=True, eq=False)
class SmoothModel:
    """What families say of what the causes of a fit leave.

    Attributes:
        fit: the causes beside what could be stored, which is in its simulation.
        stored: the model that has been learnt; None where all changes with time, or what seemed to last does not.
        explained: what is said of the rows (n, 3) [m].
        unstored: the part of it that is not in the fit's simulation, since it changes with time.
        unseen: by how much the stored simulation predicts each row otherwise for having been fitted to it (n, 3) [m].
    """

    fit: Fit
    stored: Unexplained | None
    explained: FloatArray
    unstored: FloatArray
    unseen: FloatArray


def smooth_model(fit: Fit, families: Sequence[Family], blocks: Blocks) -> SmoothModel:
    """Learn the families' functions beside the causes of `fit`."""
    lasting = [family for family in families if TIME not in family.drivers]
    timed = [family for family in families if TIME in family.drivers]
    functions = _Functions(fit, lasting)
    amounts = _Amounts(fit, functions.columns, _timed(fit, timed), blocks)
    causes = _Amounts(fit, functions.columns[:, :, :0], _timed(fit, ()), blocks)
    if not lasting or (timed and amounts.lasting_missed > causes.lasting_missed):
        said = amounts.said + amounts.in_time
        return SmoothModel(fit, None, said, said, causes.unseen)
    stored = functions.stored(amounts.of_functions, _LEFT_OUT * _noise_m(fit))
    simulation = Simulation(fit.simulation.robot, fit.simulation.effects, stored)
    beside = fitted(fit.observations, simulation, fit.nuisances, fit.noise)
    later = _Amounts(beside, functions.columns[:, :, :0], _timed(beside, timed), blocks)
    explained = functions.columns @ amounts.of_functions + later.in_time
    return SmoothModel(beside, stored, explained, later.in_time, amounts.unseen)


def _noise_m(fit: Fit) -> float:
    """RMS length of the noise [m]."""
    roots = np.linalg.inv(fit.observations.whitening)
    return fit.noise.sigma * float(np.sqrt(np.square(roots).sum(axis=(1, 2)).mean()))


def _timed(fit: Fit, families: Sequence[Family]) -> FloatArray:
    """Columns (n, 3, p), each of an RMS of one, of what changes with time."""
    columns = _beside([family.columns(fit.run) for family in families], len(fit.residuals))
    return columns / np.maximum(np.sqrt(3.0 * np.square(columns).mean(axis=(0, 1))), 1e-300)


def _beside(columns: Sequence[FloatArray], rows: int) -> FloatArray:
    return np.concatenate([np.empty((rows, 3, 0)), *columns], axis=2)


class _Functions:
    """The functions of families that depend on the readings alone, each moving the marker by 1 m (RMS) all over.

    They are taken along the rigid chain with the effects that it can have, so that they are functions of the readings
    and of nothing else.
    """

    def __init__(self, fit: Fit, families: Sequence[Family]) -> None:
        self._simulation, self._given = fit.simulation, fit.observations.motion.q
        # A slide's functions reach from its lowest reading to its highest.
        ends = [f(self._given[:, k]) for k in range(self._given.shape[1]) for f in (np.argmin, np.argmax)]
        self._ends = self._given[ends]
        self._robot = fit.simulation.robot
        self._x = self._robot.chain.positions(self._given)
        self._centre, self._spread = self._x.mean(axis=0), self._x.std(axis=0) + 1e-9
        self._families = families
        wide = self._at(self._wide())
        self._scales = np.maximum(np.sqrt(3.0 * np.square(wide).mean(axis=(0, 1))), 1e-12)

    @cached_property
    def columns(self) -> FloatArray:
        """At the rows of the fit (n, 3, p)."""
        return self._at(self._given) / self._scales

    def stored(self, amounts: FloatArray, tolerance_m: float) -> Unexplained:
        """The functions times amounts (p,), and what the simulation has already, as a model."""
        before = self._simulation.residual
        shares = amounts / self._scales
        if before is None and not any(family.at for family in self._families):
            return place_map(self._robot, lambda x: self._of_place(x) @ shares, self._x, tolerance_m)

        def shift(q: FloatArray) -> FloatArray:
            new = self._at(q) @ shares
            return new if before is None else new + before.predict(q)

        return smooth_map(self._robot, shift, self._given, tolerance_m)

    def _at(self, q: FloatArray) -> FloatArray:
        run = self._simulation.rigid.run(Motion.still(np.concatenate([self._ends, q])))
        x = self._robot.chain.positions(run.motion.q)
        columns = [family.columns(run) if family.at else self._of_place(x) for family in self._families]
        columns += [self._finer(run, *f.at, *f.drivers) for f in self._families if len(f.at) == len(f.drivers) == 1]
        return _beside(columns, len(x))[len(self._ends) :]

    def _finer(self, run: Simulated, joint: int, driver: int) -> FloatArray:
        """An error of a joint that changes faster with another than its family has it (n, 3, p)."""
        low, high = self._given[:, driver].min(), self._given[:, driver].max()
        scale = np.pi / (high - low) if self._robot.chain.prismatic[driver] else 1.0
        angles = scale * run.motion.q[:, [driver]] * np.arange(_FINER[0], _FINER[1] + 1)
        waves = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
        return run.by_joint[:, :, [joint]] * waves[:, None, :]

    def _of_place(self, x: FloatArray) -> FloatArray:
        """Any cubic function (n, 3, 60) of where the marker is: one of its rays has poles, which no map can have."""
        place = (x - self._centre) / self._spread
        products = [np.ones((len(x), 1)), place]
        for degree in (2, 3):
            chosen = combinations_with_replacement(range(3), degree)
            products += [place[:, indices].prod(axis=1, keepdims=True) for indices in map(list, chosen)]
        amounts = np.concatenate(products, axis=1)
        return (np.eye(3)[:, :, None] * amounts[:, None, None, :]).reshape(len(x), 3, -1)

    def _wide(self) -> FloatArray:
        """Postures all over the joints' range; of slides, over that of the recording."""
        robot, q = self._robot, self._given
        slides = robot.chain.prismatic
        low = np.where(slides, q.min(axis=0), np.maximum(robot.lower, -np.pi))
        high = np.where(slides, q.max(axis=0), np.minimum(robot.upper, np.pi))
        return low + (high - low) * np.random.default_rng(0).uniform(size=(_WIDE, q.shape[1]))


class _Amounts:
    """How much of each function, with the causes' numbers free beside them."""

    def __init__(self, fit: Fit, functions: FloatArray, timed: FloatArray, blocks: Blocks) -> None:
        self._fit, self._blocks = fit, blocks
        self._causes, self._lasting = fit.run_columns.shape[2], functions.shape[2]
        self._columns = np.concatenate([fit.run_columns, functions, timed], axis=2)
        weighted = fit.weighted(self._columns)
        self._flat, self._left = weighted.reshape(fit.left.size, -1), fit.left.ravel()
        self._folds = np.repeat(blocks.fold, 3)
        tried = [(self._missed(size), size) for size in _SIZES]
        self._size = min(tried)[1]
        self._all = self._solved(np.ones(len(self._left), dtype=np.bool_), self._size)

    @property
    def of_functions(self) -> FloatArray:
        """Of the functions that last (p,)."""
        return self._all[self._causes :][: self._lasting]

    @property
    def in_time(self) -> FloatArray:
        """What those that change with time say of the rows (n, 3) [m]."""
        first = self._causes + self._lasting
        return self._columns[:, :, first:] @ self._all[first:]

    @property
    def lasting_missed(self) -> float:
        """What causes and lasting functions leave (sum of squares, whitened) of rows that were not fitted."""
        left = self._fit.weighted(
            (self._fit.observations.x - self._fit.run.measured - self.said + self.unseen)[:, :, None]
        )
        return float(np.square(left).sum())

    @property
    def said(self) -> FloatArray:
        """What causes and lasting functions say more of the rows (n, 3) [m]."""
        lasting = slice(0, self._causes + self._lasting)
        return self._columns[:, :, lasting] @ self._all[lasting]

    @cached_property
    def unseen(self) -> FloatArray:
        """By how much causes and lasting functions say more of rows (n, 3) [m] than if these had not been fitted."""
        more = np.zeros_like(self._fit.residuals)
        lasting = slice(0, self._causes + self._lasting)
        for fold in np.unique(self._blocks.fold):
            rows = self._blocks.fold == fold
            change = self._all - self._solved(self._folds != fold, self._size)
            more[rows] = self._columns[rows][:, :, lasting] @ change[lasting]
        return more

    def _missed(self, size: float) -> float:
        """What is left (sum of squares) of rows that were not fitted."""
        total = 0.0
        for fold in np.unique(self._folds):
            rows = self._folds == fold
            total += float(np.square(self._left[rows] - self._flat[rows] @ self._solved(~rows, size)).sum())
        return total

    def _solved(self, rows: np.ndarray, size: float) -> FloatArray:
        free = self._flat.shape[1] - self._causes
        precision = [prior_precision(self._fit.simulation, self._fit.nuisances)]
        precision.append(np.full(free, (size * _noise_m(self._fit)) ** -2))
        ridge = np.diag(np.concatenate(precision)) * self._fit.noise.sigma**2
        flat = self._flat[rows]
        return solved(flat.T @ flat + ridge, flat.T @ self._left[rows])
