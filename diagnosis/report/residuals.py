"""Compute the quantities that a report plots: errors before and after, and their possible dependences."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from bodyschema.diagnosis.diagnosis import Diagnosis
from bodyschema.effects import Effect, Simulation
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray


class ResidualSettings:
    points, arrows = 450, 220  # maximum of points in a plot, and of arrows in a projection
    # A joint's rows count if it moves the marker by this share of its median effect.
    tells = 0.5
    bins, min_in_a_bin = 16, 8
    significant = 1e-3  # a larger p-value counts as chance


@dataclass(frozen=True)
class Bins:
    """Means of bins with equal numbers of rows: x (b,), y (b,), and half the 95 % interval of y (b,)."""

    x: FloatArray
    y: FloatArray
    half: FloatArray


class Residuals:
    """Held-out errors (n, 3) [m] before and after, and the rows (n,) that are the marker."""

    def __init__(self, diagnosis: Diagnosis) -> None:
        self.diagnosis = diagnosis
        self.run = diagnosis.extended.run
        self.motion = self.run.motion
        self.robot = self.run.simulation.robot
        self.rows: NDArray[np.intp] = np.flatnonzero(diagnosis.markers)

    @cached_property
    def before(self) -> FloatArray:
        return self.diagnosis.errors["aligned"]

    @cached_property
    def after(self) -> FloatArray:
        return self.diagnosis.errors["extended"]

    def some(self, count: int, rows: NDArray[np.intp] | None = None) -> NDArray[np.intp]:
        """Return at most `count` of the rows, in order, sampled with the diagnosis' seed."""
        rows = self.rows if rows is None else rows
        if len(rows) <= count:
            return rows
        return np.sort(np.random.default_rng(self.diagnosis.seed).choice(rows, count, replace=False))

    @property
    def calibration(self) -> StereoCalibration | None:
        return self.robot.calibration

    @property
    def timed(self) -> bool:
        """True if the recording has times."""
        return self.motion.t is not None

    @cached_property
    def clock(self) -> FloatArray:
        """Times [s] or row numbers (n,)."""
        return self.motion.clock

    @property
    def clock_label(self) -> str:
        return "time [s]" if self.timed else "row"

    def slides(self, joint: int) -> bool:
        """Return True if a joint is prismatic."""
        return bool(self.robot.chain.prismatic[joint])

    def angles(self, joint: int) -> FloatArray:
        """Return a joint's readings (n,) [°, mm]."""
        return self.motion.q[:, joint] * self.unit(joint)[0]

    def unit(self, joint: int) -> tuple[float, str]:
        """Return factor and name of a joint's display unit."""
        return (1e3, "mm") if self.slides(joint) else (np.degrees(1.0), "°")

    def projected_amount(self, direction: FloatArray, errors: FloatArray) -> FloatArray:
        """Return the most probable multiple (n,) of `direction` (n, 3) in errors (n, 3) [m], for the noise's shape."""
        expected, seen = (np.einsum("nij,nj->ni", self.whitening, vectors) for vectors in (direction, errors))
        return np.einsum("ni,ni->n", expected, seen) / np.maximum(np.square(expected).sum(axis=1), 1e-300)

    @property
    def whitening(self) -> FloatArray:
        """Whitening (n, 3, 3) that makes the noise isotropic."""
        return self.diagnosis.extended.observations.whitening

    def along(self, joint: int, errors: FloatArray) -> FloatArray:
        """Return errors (n,) [mm] along the direction in which a joint moves the marker."""
        derivative = self.run.by_joint[:, :, joint]
        return 1e3 * self.projected_amount(derivative, errors) * np.linalg.norm(derivative, axis=1)

    def as_angle(self, joint: int, errors: FloatArray) -> FloatArray:
        """Return the joint error (n,) [°, mm] that best explains errors (n, 3)."""
        return self.unit(joint)[0] * self.projected_amount(self.run.by_joint[:, :, joint], errors)

    def rows_moved_by(self, joint: int) -> NDArray[np.intp]:
        """Return the rows in which a joint moves the marker well."""
        derivative = np.einsum("nij,nj->ni", self.whitening, self.run.by_joint[:, :, joint])
        arm = np.linalg.norm(derivative, axis=1)[self.rows]
        return self.rows[arm >= ResidualSettings.tells * np.median(arm)]

    @cached_property
    def direction(self) -> NDArray[np.intp]:
        """Last direction of each joint (n, d): 1, -1, or 0 before its first move in the run."""
        signs = np.sign(self.motion.moves).astype(np.intp)
        for first, end in self.motion.runs:
            for k in range(first + 1, end):
                signs[k] = np.where(signs[k] == 0, signs[k - 1], signs[k])
        return signs

    def contribution(self, effect: Effect) -> FloatArray:
        """Return the change of the measurements by an effect (n, 3) [m]."""
        return self.run.measured - self._simulated([e for e in self.run.simulation.effects if e is not effect])

    def contribution_with(self, effect: Effect, values: FloatArray) -> FloatArray:
        """Return the change of the measurements by an effect with other parameters (n, 3) [m]."""
        others = [e for e in self.run.simulation.effects if e is not effect]
        return self._simulated([*others, effect.with_values(values)]) - self._simulated(others)

    def _simulated(self, effects: list[Effect]) -> FloatArray:
        simulation: Simulation = self.run.simulation.with_effects(effects)
        return simulation.positions(self.motion)

    def pixels(self, x: FloatArray) -> FloatArray:
        """Return positions in the left image (n, 2) [px] of points (n, 3); needs a calibration."""
        assert self.calibration is not None
        return self.calibration.project(x)[:, :2]


def binned(x: FloatArray, y: FloatArray) -> Bins:
    member = _members(x)
    count = np.bincount(member).astype(np.float64)
    mean_x, mean_y = np.bincount(member, x) / count, np.bincount(member, y) / count
    spread = np.sqrt(np.bincount(member, np.square(y - mean_y[member])) / np.maximum(count - 1.0, 1.0))
    return Bins(mean_x, mean_y, 1.96 * spread / np.sqrt(count))


def structure(x: FloatArray, y: FloatArray) -> float:
    """Return the share of the variance of y that x explains, beyond chance; 0 if not significant (ANOVA)."""
    member = _members(x)
    n, groups = len(y), int(member.max()) + 1
    if groups < 2 or n <= groups:
        return 0.0
    means = np.bincount(member, y) / np.bincount(member)
    inside = float(np.square(y - means[member]).sum())
    between = float(np.square(means[member] - y.mean()).sum())
    ratio = (between / (groups - 1)) / max(inside / (n - groups), 1e-300)
    if fdtrc(groups - 1, n - groups, ratio) > ResidualSettings.significant:
        return 0.0
    share = between / max(between + inside, 1e-300)
    return max(share - (groups - 1) / (n - 1), 0.0)


def _members(x: FloatArray) -> NDArray[np.intp]:
    """Return the bin of each row (n,): equal numbers of rows per bin, or one bin per value if x has few."""
    values, member = np.unique(np.round(x, 9), return_inverse=True)
    if len(values) <= ResidualSettings.bins:
        return member
    bins = min(ResidualSettings.bins, max(len(x) // ResidualSettings.min_in_a_bin, 1))
    of_row = np.empty(len(x), dtype=np.intp)
    of_row[np.argsort(x, kind="stable")] = np.arange(len(x)) * bins // len(x)
    return of_row
