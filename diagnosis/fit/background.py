"""Model the manufacturing tolerances: small errors of every link, axis and drive.

The position and axis of each link, its joint offset included, deviate by N(0, (s τ)²). So do the small periodic errors
of each drive. The data determine the scales s: for lengths, angles, drives and slides. This background is part of
every fit and never a finding; a cause is larger.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects import Effect, PipelineRun, Simulation
from bodyschema.interfaces.records import FloatArray


class BackgroundSettings:
    # Workshop tolerances (1 sigma): link length [m], axis or joint offset [rad], drive over a turn [rad].
    length_m, angle_rad, drive_rad = 0.3e-3, float(np.radians(0.06)), float(np.radians(0.01))
    drive_m = 0.03e-3  # tolerance of a prismatic joint's drive [m]
    like_others = 3.0  # a drive error within this multiple of the usual size is a tolerance
    counts_in_full = 1e-9  # a row counts in full if its weight differs from 1 by less
    spread = 2.0  # prior standard deviation of the logarithms of the scales
    # Smallest and largest scale. With all at the smallest, the arm is exactly as described, such as a simulated one.
    smallest_scale, largest_scale = 1e-3, 10.0


class Scales(NamedTuple):
    """Sizes of the tolerances as multiples of `length_m`, `angle_rad`, `drive_rad`, and `drive_m` for slides."""

    lengths: float = 1.0
    angles: float = 1.0
    drives: float = 1.0
    slides: float = 1.0

    @property
    def limited_to_workshop(self) -> Scales:
        """Return these scales, each limited to 1 (a workshop's tolerance)."""
        return Scales(*np.minimum(self, 1.0).tolist())

    @property
    def excess_over_workshop(self) -> float:
        """Logarithm of the larger scale of lengths and angles, clipped to 0 (a workshop's) and 1 (e times that)."""
        return float(np.clip(np.log(self[:2]), 0.0, 1.0).max())

    @property
    def prior_penalty(self) -> float:
        """Penalty of these scales under their prior, relative to a scale of 1; 0 for an exact arm [nats]."""
        if max(self) <= BackgroundSettings.smallest_scale:
            return 0.0
        return float(0.5 * np.square(np.log(self) / BackgroundSettings.spread).sum())


class Background:
    """Small errors throughout a simulated run, linearised about those that the simulation already has.

    Args:
        run: run of a simulation, whose background may be empty.
        whitening: (n, 3, 3), to units in which the stated noise has unit covariance.
        scales: scales of the tolerances; None for no background at all.
        before: the background from which this one is derived; None if the simulation's own errors are known and the
            tolerances are centred on them.
    """

    def __init__(
        self, run: PipelineRun, whitening: FloatArray, scales: Scales | None, before: Background | None = None
    ) -> None:
        simulation = run.simulation
        self._whitening, self.scales = whitening, scales
        own = () if scales is None else simulation.background or background_effects(simulation, run.motion.q)
        # the effects with zero amounts: a link at each joint, eccentricity and ripple of each drive
        self.effects = tuple(effect.with_amounts(0.0) for effect in own)
        amounts = np.concatenate([np.empty(0), *(effect.values[effect.amounts] for effect in own)])
        # Tolerances are centred here.
        self._centre = amounts
        if before is not None and before.scales is not None:
            self._centre = np.append(before._centre, np.zeros(len(amounts) - len(before._centre)))
        self.start = amounts - self._centre  # the simulation's amounts (p,), about which the columns are linearised
        parts = [run.columns(effect)[:, :, effect.amounts] for effect in own]
        # derivatives (n, 3, p) [m] of the measured positions with respect to the amounts
        self.columns = np.concatenate([np.empty((len(run.motion), 3, 0)), *parts], axis=2)
        self.group = np.concatenate([np.empty(0, int), *map(_groups, self.effects)])
        units = np.concatenate([np.empty(0), *map(_units, self.effects)])
        # prior standard deviation of each amount (p,)
        self.tolerances = units if scales is None else units * np.asarray(scales)[self.group]

    def shift(self, amounts: FloatArray) -> FloatArray:
        """Return the change of the measured positions (n, 3) [m] when the amounts (p,) differ from the simulation's."""
        return self.columns @ (amounts - self.start)

    def with_amounts(self, amounts: FloatArray) -> tuple[Effect, ...]:
        """Return the background's effects with amounts (p,)."""
        ends = np.cumsum([len(effect.amounts) for effect in self.effects])
        return tuple(
            effect.with_amounts((self._centre + amounts)[end - len(effect.amounts) : end])
            for effect, end in zip(self.effects, ends, strict=True)
        )

    @property
    def given(self) -> tuple[Effect, ...]:
        """Known errors of the simulation, on which the tolerances are centred; empty if all are 0."""
        given = self.with_amounts(np.zeros_like(self.start))
        return given if self._centre.any() else ()

    def is_within_tolerance(self, effect: Effect) -> bool:
        """Return True if an effect is a periodic drive error no larger than those of other drives."""
        if self.scales is None or not effect.kind.of_drive:
            return False
        usual = (self.scales.slides if effect.prismatic else self.scales.drives) * _of_drive(effect)
        return float(np.linalg.norm(effect.values[effect.amounts])) < BackgroundSettings.like_others * usual

    @cached_property
    def precision(self) -> FloatArray:
        """Prior precision of the amounts (p,)."""
        return 1.0 / np.square(self.tolerances)

    @cached_property
    def white(self) -> FloatArray:
        """Whitened `columns` (3 n, p)."""
        return (self._whitening @ self.columns).reshape(3 * len(self.columns), len(self.tolerances))

    @cached_property
    def _inner(self) -> FloatArray:
        return self.white.T @ self.white

    def inner(self, weights: FloatArray) -> FloatArray:
        """Return the products (p, p) of the whitened columns, rows weighted (n,)."""
        partly = partially_weighted_rows(weights)
        rows = self.white.reshape(len(weights), -1)[partly] * np.sqrt(1.0 - weights[partly])[:, None]
        flat = rows.reshape(3 * len(partly), self.white.shape[1])
        return self._inner - flat.T @ flat

    @cached_property
    def spectrum(self) -> FloatArray:
        """Squared lengths (p,) of the background's changes, in units of the stated noise."""
        return np.maximum(np.linalg.eigvalsh(self._inner * np.outer(self.tolerances, self.tolerances)), 0.0)

    def effective_dof(self, sigma: float) -> float:
        """Return the effective number of parameters of the background for noise `sigma` times the stated one."""
        return float((self.spectrum / (self.spectrum + sigma**2)).sum())

    def occam_cost(self, sigma: float) -> float:
        """Return the Occam cost of the background's free parameters [nats]."""
        return float(0.5 * np.log1p(self.spectrum / sigma**2).sum())


def partially_weighted_rows(weights: FloatArray) -> NDArray[np.intp]:
    """Return the rows whose weights (n,) are below 1: only these need to be visited again by weighted products."""
    return np.flatnonzero(1.0 - weights > BackgroundSettings.counts_in_full)


def background_effects(simulation: Simulation, q: FloatArray) -> tuple[Effect, ...]:
    """Return the tolerance effects, with zero amounts, of each joint that moves over q (n, d) and the links between."""
    robot, found = simulation.robot, []
    for k, joint in enumerate(robot.joints):
        found.append(Effect.at(robot, "link_geometry", joint))
        if not robot.chain.prismatic[k] and np.ptp(q[:, k]) > 0.0:
            found.append(Effect.at(robot, "joint_eccentricity", joint))
            # Periodic errors of every drive: once and twice per turn of the joint.
            found.append(Effect.at(robot, "joint_ripple", joint, values=[0.0, 0.0, 2.0]))
    return tuple(effect.with_amounts(0.0).with_ordinal(-1) for effect in found)


def _groups(effect: Effect) -> np.ndarray:
    if effect.kind.of_drive:
        # Errors of ball screws are independent of those of gears and links.
        return np.full(len(effect.amounts), 3 if effect.prismatic else 2)
    return np.array([0, 0, 0, 1, 1, 1])


def _units(effect: Effect) -> FloatArray:
    if effect.kind.of_drive:
        return np.full(len(effect.amounts), _of_drive(effect))
    return np.repeat([BackgroundSettings.length_m, BackgroundSettings.angle_rad], 3)


def _of_drive(effect: Effect) -> float:
    return BackgroundSettings.drive_m if effect.prismatic else BackgroundSettings.drive_rad
