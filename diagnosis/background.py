"""The background: each link, axis and drive of an arm is off by a little, within what its makers tolerate.

A link's place and its axis, the zero with it, are off by N(0, (s τ)²), and so are the small periodic errors of each
drive. One scale s for lengths, one for angles and one for the drives are what the data tell. The background is part
of every fit and never a finding; a cause is what is larger.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from bodyschema.effects import Effect, Simulated, Simulation
from bodyschema.interfaces.records import FloatArray

# What workshops tolerate: of a link's length, of an axis or a zero, and of a drive over a turn [m, rad].
LENGTH_M, ANGLE_RAD, DRIVE_RAD = 0.3e-3, float(np.radians(0.06)), float(np.radians(0.01))
# Of a sliding joint's drive [m].
_DRIVE_M = 0.03e-3
# The periodic errors of a drive that every arm has: once and twice a turn of the joint.
_TWICE = 2.0
_PERIODIC = ("joint_eccentricity", "joint_ripple")
# So many times as large as drives' errors usually are an error of a drive is one like others.
_LIKE_OTHERS = 3.0
# A row whose weight differs from one by less counts in full.
_COUNTS_IN_FULL = 1e-9
# Of the scales' logarithms before the data.
SPREAD = 2.0


class Scales(NamedTuple):
    """How many times larger tolerances are than `LENGTH_M`, `ANGLE_RAD` and `DRIVE_RAD`."""

    lengths: float = 1.0
    angles: float = 1.0
    drives: float = 1.0

    @property
    def no_larger(self) -> Scales:
        """These, but none larger than a workshop's."""
        return Scales(*np.minimum(self, 1.0).tolist())

    @property
    def doubt(self) -> float:
        """How improbable they are before the data, beside those of a workshop [nats]."""
        return float(0.5 * np.square(np.log(self) / SPREAD).sum())


class Background:
    """Small errors everywhere beside a run of a simulation, to first order about those that the simulation has.

    Args:
        run: of a simulation, whose background may be empty.
        whitening: (n, 3, 3), to units in which the stated noise is one.
        scales: of what is tolerated; None for no background at all.
        before: the background from which this one has come; None where a simulation's own errors are known, and what
            is tolerated lies about them.

    Attributes:
        effects: those of the background at rest: a link at each joint, eccentricity and ripple of each drive.
        columns: derivatives (n, 3, p) [m] of what is measured by its amounts.
        tolerances: how large each may be, 1-sigma (p,).
        start: the amounts (p,) of the simulation, about which the columns are.
    """

    def __init__(
        self, run: Simulated, whitening: FloatArray, scales: Scales | None, before: Background | None = None
    ) -> None:
        simulation = run.simulation
        self._whitening, self.scales = whitening, scales
        own = () if scales is None else simulation.background or background_effects(simulation, run.motion.q)
        self.effects = tuple(_resting(effect) for effect in own)
        amounts = np.concatenate([np.empty(0), *(effect.values[effect.amounts] for effect in own)])
        # What is tolerated counts from here.
        self._centre = amounts
        if before is not None and before.scales is not None:
            self._centre = np.append(before._centre, np.zeros(len(amounts) - len(before._centre)))
        self.start = amounts - self._centre
        parts = [run.columns(effect)[:, :, effect.amounts] for effect in own]
        self.columns = np.concatenate([np.empty((len(run.motion), 3, 0)), *parts], axis=2)
        self.group = np.concatenate([np.empty(0, int), *map(_groups, self.effects)])
        units = np.concatenate([np.empty(0), *map(_units, self.effects)])
        self.tolerances = units if scales is None else units * np.asarray(scales)[self.group]

    def shift(self, amounts: FloatArray) -> FloatArray:
        """What amounts (p,) other than those of the simulation add to what is measured (n, 3) [m]."""
        return self.columns @ (amounts - self.start)

    def with_amounts(self, amounts: FloatArray) -> tuple[Effect, ...]:
        """The background's effects with amounts (p,)."""
        ends = np.cumsum([len(effect.amounts) for effect in self.effects])
        return tuple(
            _with(effect, (self._centre + amounts)[end - len(effect.amounts) : end])
            for effect, end in zip(self.effects, ends, strict=True)
        )

    @property
    def given(self) -> tuple[Effect, ...]:
        """The errors about which everything is tolerated, as a simulation had them beforehand; none that are 0."""
        given = self.with_amounts(np.zeros_like(self.start))
        return given if self._centre.any() else ()

    def tolerates(self, effect: Effect) -> bool:
        """Whether an effect is a periodic error of a drive that is no larger than that of others."""
        if self.scales is None or effect.name not in _PERIODIC:
            return False
        usual = self.scales.lengths * _DRIVE_M if effect.prismatic else self.scales.drives * DRIVE_RAD
        return float(np.linalg.norm(effect.values[effect.amounts])) < _LIKE_OTHERS * usual

    @cached_property
    def precision(self) -> FloatArray:
        """Of the amounts beforehand (p,)."""
        return 1.0 / np.square(self.tolerances)

    @cached_property
    def white(self) -> FloatArray:
        """`columns` (3 n, p), whitened."""
        return (self._whitening @ self.columns).reshape(3 * len(self.columns), len(self.tolerances))

    @cached_property
    def _inner(self) -> FloatArray:
        return self.white.T @ self.white

    def inner(self, weights: FloatArray) -> FloatArray:
        """Products (p, p) of the whitened columns with one another, rows weighted (n,)."""
        return weighted_products(self.white, self._inner, weights)

    @cached_property
    def spectrum(self) -> FloatArray:
        """Squared lengths of what the background changes (p,), in units of the stated noise."""
        return np.maximum(np.linalg.eigvalsh(self._inner * np.outer(self.tolerances, self.tolerances)), 0.0)

    def spent(self, sigma: float) -> float:
        """How many numbers of the data it takes for itself where the noise is `sigma` times the stated one."""
        return float((self.spectrum / (self.spectrum + sigma**2)).sum())

    def volume(self, sigma: float) -> float:
        """What having so many possibilities costs [nats]."""
        return float(0.5 * np.log1p(self.spectrum / sigma**2).sum())


def weighted_products(columns: FloatArray, inner: FloatArray, weights: FloatArray) -> FloatArray:
    """Products (p, p) of columns (3 n, p) with one another, rows weighted (n,), from those without weights.

    Only the rows that do not count in full are gone through.
    """
    partly = np.flatnonzero(1.0 - weights > _COUNTS_IN_FULL)
    rows = columns.reshape(len(weights), 3, columns.shape[1])[partly] * np.sqrt(1.0 - weights[partly])[:, None, None]
    flat = rows.reshape(3 * len(partly), columns.shape[1])
    return inner - flat.T @ flat


def background_effects(simulation: Simulation, q: FloatArray) -> tuple[Effect, ...]:
    """What is a little off everywhere, at rest: at each joint that moves over q (n, d), and each link between."""
    robot, found = simulation.robot, []
    for k, joint in enumerate(robot.joints):
        found.append(_resting(Effect.at(robot, "link_geometry", joint)))
        if not robot.chain.prismatic[k] and np.ptp(q[:, k]) > 0.0:
            found.append(_resting(Effect.at(robot, "joint_eccentricity", joint)))
            found.append(_resting(Effect.at(robot, "joint_ripple", joint, values=[0.0, 0.0, _TWICE])))
    return tuple(effect.one_more(-1) for effect in found)


def _resting(effect: Effect) -> Effect:
    return _with(effect, np.zeros(len(effect.amounts)))


def _with(effect: Effect, amounts: FloatArray) -> Effect:
    values = effect.values.copy()
    values[effect.amounts] = amounts
    return effect.with_values(values)


def _groups(effect: Effect) -> np.ndarray:
    if effect.name != "link_geometry":
        # A screw is a length: how true gears run says nothing of it.
        return np.full(len(effect.amounts), 0 if effect.prismatic else 2)
    return np.array([0, 0, 0, 1, 1, 1])


def _units(effect: Effect) -> FloatArray:
    if effect.name != "link_geometry":
        return np.full(len(effect.amounts), _DRIVE_M if effect.prismatic else DRIVE_RAD)
    return np.repeat([LENGTH_M, ANGLE_RAD], 3)
