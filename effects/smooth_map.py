"""Store smooth functions of the readings as KB-Maps, in which a joint may appear several times.

A KB-Map has {1, cos θ, sin θ} of each joint. With columns θ, 2θ, 4θ and 8θ, as if of four joints, it has all harmonics
up to the fifteenth. Sums of products of harmonics, such as the displacements of a rigid chain, are then exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from kbmaps import JointBasis, KBMap

from .unexplained import PLACE, Unexplained

Shift = Callable[[FloatArray], FloatArray]


class _Settings:
    max_harmonics, largest_net = 15, 3**12  # maximum of harmonics, and of control points of a net
    # Points along an axis and lines on which harmonics are sought; rows per batch.
    points, lines, rows = 64, 12, 4096
    largest_grid = 400_000  # maximum of grid points


@dataclass(frozen=True)
class _Axis:
    """Functions of one joint: harmonics of a turn; for a prismatic joint, of twice its stroke, also times the path."""

    slides: bool
    # low, high: range of a prismatic joint for the function [m]
    low: float
    high: float
    harmonics: int  # number of harmonics; 0 for a revolute joint means no dependence on it

    @property
    def scale(self) -> float:
        return np.pi / (self.high - self.low) if self.slides else 1.0

    def spread(self, count: int) -> FloatArray:
        """Return `count` readings spread to separate the functions."""
        if self.slides:
            return 0.5 * (
                self.low + self.high - (self.high - self.low) * np.cos(np.pi * np.arange(count) / (count - 1))
            )
        return 2.0 * np.pi * np.arange(count) / count

    @property
    def grid(self) -> FloatArray:
        """Smallest set of readings that determines all functions."""
        return self.spread(4 * self.harmonics + 4 if self.slides else 2 * self.harmonics + 1)

    def functions(self, q: FloatArray) -> FloatArray:
        """Return the functions (n, functions) at readings q (n,), ordered by harmonic, the lowest first."""
        angles = self.scale * q[:, None] * np.arange(1, self.harmonics + 1)
        both = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(q), -1)
        waves = np.concatenate([np.ones((len(q), 1)), both], axis=1)
        if not self.slides:
            return waves
        path = (q - self.low) / (self.high - self.low)
        return np.stack([waves, path[:, None] * waves], axis=2).reshape(len(q), -1)

    @property
    def last(self) -> int:
        return 4 if self.slides else 2

    @property
    def factors(self) -> list[float]:
        """Factors on the readings for the columns of a map."""
        waves = [self.scale * 2.0**k for k in range(int(self.harmonics).bit_length())]
        return [1.0, *waves] if self.slides else waves

    @property
    def bases(self) -> list[JointBasis]:
        waves = [JointBasis.trigonometric()] * int(self.harmonics).bit_length()
        return [JointBasis.prismatic(self.low, self.high), *waves] if self.slides else waves

    @property
    def in_columns(self) -> FloatArray:
        """Functions in terms of the column bases (functions, m, ..., m)."""
        q = self.spread(4 * _Settings.points)
        columns = [basis.weights(factor * q) for basis, factor in zip(self.bases, self.factors, strict=True)]
        products = reduce(
            lambda a, b: (a[:, :, None] * b[:, None, :]).reshape(len(q), -1), columns, np.ones((len(q), 1))
        )
        shares = np.linalg.lstsq(products, self.functions(q), rcond=1e-12)[0]
        return np.asarray(shares.T, dtype=np.float64).reshape(-1, *(basis.size for basis in self.bases))


def smooth_map(robot: RobotDescription, shift: Shift, q: FloatArray, tolerance_m: float) -> Unexplained:
    """Fit a storable model to a smooth function of the readings.

    Args:
        shift: function of readings (n, d) that returns shifts (n, 3) [m]; for revolute joints, at any angle.
        q: readings (n, d) at which the model has to be right.
        tolerance_m: parts smaller than this (RMS) are left out, and with them joints without influence.
    """
    return _learnt(robot, robot.joints, robot.chain.prismatic.tolist(), shift, q, tolerance_m)


def place_map(robot: RobotDescription, shift: Shift, x: FloatArray, tolerance_m: float) -> Unexplained:
    """Fit a storable model to a function of the described robot's marker position, to be right at x (n, 3) [m]."""
    return _learnt(robot, PLACE, [True] * len(PLACE), shift, x, tolerance_m)


def _learnt(
    robot: RobotDescription,
    names: Sequence[str],
    slides: Sequence[bool],
    shift: Shift,
    q: FloatArray,
    tolerance_m: float,
) -> Unexplained:
    axes = [_axis(slides[k], shift, q, k, tolerance_m) for k in range(q.shape[1])]
    while np.prod([float(len(axis.grid)) for axis in axes]) > _Settings.largest_grid:
        most = max(range(len(axes)), key=lambda k: axes[k].harmonics)
        axes[most] = replace(axes[most], harmonics=axes[most].harmonics - 1)
    axes, amounts = _pruned(axes, _amounts(axes, shift), tolerance_m)
    if not any(axis.bases for axis in axes):
        axes[0], amounts = replace(axes[0], harmonics=1), np.pad(amounts, [(0, 2), *[(0, 0)] * (amounts.ndim - 1)])
    return _stored(robot, names, axes, amounts)


def _axis(slides: bool, shift: Shift, q: FloatArray, joint: int, tolerance_m: float) -> _Axis:
    """Find the number of harmonics of one joint, on some lines through readings."""
    low, high = float(q[:, joint].min()), float(q[:, joint].max())
    if slides and high - low < 1e-6:
        low, high = low - 0.5, low + 0.5
    axis = _Axis(slides, low, high, 0)
    points = axis.spread(_Settings.points)
    lines = np.repeat(q[np.linspace(0, len(q) - 1, _Settings.lines).round().astype(int)], _Settings.points, axis=0)
    lines[:, joint] = np.tile(points, _Settings.lines)
    values = np.swapaxes(shift(lines).reshape(_Settings.lines, _Settings.points, 3), 0, 1).reshape(_Settings.points, -1)
    for harmonics in range(_Settings.max_harmonics + 1):
        axis = replace(axis, harmonics=harmonics)
        functions = axis.functions(points)
        left = values - functions @ np.linalg.lstsq(functions, values, rcond=1e-10)[0]
        # A quarter, since there are several joints.
        if np.sqrt(3.0 * np.square(left).mean()) < 0.25 * tolerance_m:
            break
    return axis


def _amounts(axes: Sequence[_Axis], shift: Shift) -> FloatArray:
    """Return amounts of all products of the axes' functions (functions, ..., functions, 3)."""
    grids = [axis.grid for axis in axes]
    q = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1).reshape(-1, len(axes))
    values = np.concatenate([shift(q[first : first + _Settings.rows]) for first in range(0, len(q), _Settings.rows)])
    amounts = values.reshape(*(len(grid) for grid in grids), 3)
    for k, axis in enumerate(axes):
        solve = np.linalg.pinv(axis.functions(grids[k]), rcond=1e-10)
        amounts = np.moveaxis(np.tensordot(solve, amounts, axes=(1, k)), 0, k)
    return amounts


def _pruned(axes: list[_Axis], amounts: FloatArray, tolerance_m: float) -> tuple[list[_Axis], FloatArray]:
    """Remove the highest harmonics without influence; if the net is still too large, also the least important ones."""
    squared = 0.0
    while True:
        parts = {}
        for k, axis in enumerate(axes):
            if axis.harmonics:
                part = np.take(amounts, range(amounts.shape[k] - axis.last, amounts.shape[k]), axis=k)
                # The mean square of a wave is half of its squared amplitude.
                parts[k] = 0.5 * float(np.square(part).sum())
        if not parts:
            return axes, amounts
        least = min(parts, key=lambda k: parts[k])
        net = np.prod([float(basis.size) for axis in axes for basis in axis.bases])
        if squared + parts[least] > tolerance_m**2 and net <= _Settings.largest_net:
            return axes, amounts
        squared += parts[least]
        amounts = np.take(amounts, range(amounts.shape[least] - axes[least].last), axis=least)
        axes[least] = replace(axes[least], harmonics=axes[least].harmonics - 1)


def _stored(robot: RobotDescription, names: Sequence[str], axes: Sequence[_Axis], amounts: FloatArray) -> Unexplained:
    net = np.moveaxis(amounts, -1, 0)
    for axis in axes:
        # Each round converts the first axis and moves it to the end.
        net = np.tensordot(net, axis.in_columns, axes=(1, 0))
    joints = [joint for joint, axis in zip(names, axes, strict=True) for _ in axis.bases]
    factors = [factor for axis in axes for factor in axis.factors]
    kbmap = KBMap(tuple(basis for axis in axes for basis in axis.bases), net)
    return Unexplained.of(robot, kbmap, tuple(joints), tuple(factors))
