"""Parametrised self-organising maps: products of Lagrange polynomials through a grid of poses.

PSOM (Ritter 1993; Walter 1998) uses the readings at the grid's own poses directly. PSOM+ (Klanke and Ritter 2005) fits
the grid's reference points to scattered, noisy pairs by least squares, with a penalty on roughness.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from benchmarks.peers.problem import Competitor, Fitted, Offset, Problem, any_of, at_most, needs_measuring
from kbmaps.arrays import FloatArray

_MOST_NODES = 4
_MOST_REFERENCES = 1200
_FOLDS = 5
_PENALTIES = tuple(float(penalty) for penalty in 10.0 ** np.arange(-7.0, 2.0))
_PENALTY_OF_MEAN = 1e-3


@dataclass(frozen=True)
class Grid:
    """Chebyshev nodes (which keep polynomials from oscillating) on each joint's range, scaled to -1 .. 1."""

    low: FloatArray
    high: FloatArray
    nodes: tuple[int, ...]

    @property
    def size(self) -> int:
        return math.prod(self.nodes)

    def poses(self) -> FloatArray:
        """Return the grid's poses (size, d) [rad], last joint fastest."""
        scaled = np.array(list(product(*(chebyshev(count) for count in self.nodes))))
        return self.low + 0.5 * (scaled + 1.0) * (self.high - self.low)

    def weights(self, q: FloatArray) -> FloatArray:
        """Return Lagrange weights (n, size) at q (n, d) [rad]."""
        scaled = 2.0 * (q - self.low) / (self.high - self.low) - 1.0
        out = np.ones((len(q), 1))
        for angles, count in zip(scaled.T, self.nodes, strict=True):
            out = (out[:, :, None] * lagrange(angles, chebyshev(count))[:, None, :]).reshape(len(q), -1)
        return out


def chebyshev(count: int) -> FloatArray:
    return -np.cos(np.pi * (np.arange(count) + 0.5) / count)


def lagrange(angles: FloatArray, nodes: FloatArray) -> FloatArray:
    """Return values (n, k) of the polynomials that are 1 at their own node and 0 at the others."""
    out = np.ones((len(angles), len(nodes)))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            out[:, i] *= (angles - other) / (node - other)
    return out


def nodes_for(joints: int, readings: int) -> tuple[int, ...] | None:
    """Return nodes per joint for at most `readings` poses; the first joints (long levers) get one more if it fits."""
    count = math.floor(readings ** (1.0 / joints) + 1e-9)
    if count < 1 or readings < 2**joints:
        return None
    nodes = [count] * joints
    for k in range(joints):
        if math.prod(nodes) // nodes[k] * (nodes[k] + 1) <= readings:
            nodes[k] += 1
    return tuple(nodes)


@dataclass(frozen=True)
class PSOM:
    """Reference points (size, 3) [m] on a grid, around an offset."""

    grid: Grid
    references: FloatArray
    offset: Offset | None = None

    def predict(self, q: FloatArray) -> FloatArray:
        x = self.grid.weights(q) @ self.references
        return x if self.offset is None else x + self.offset.predict(q)


def interpolated(grid: Grid, readings: FloatArray) -> PSOM:
    """Interpolate readings (size, 3) at the grid's poses."""
    return PSOM(grid, readings)


def learn_on_grid(problem: Problem, earlier: Fitted | None) -> Fitted:
    del earlier
    nodes = nodes_for(problem.joints, problem.pairs)
    if nodes is None or problem.measure is None:
        raise ValueError("a grid needs at least two poses a joint, and an arm that goes there")
    grid = Grid(problem.low, problem.high, nodes)
    return interpolated(grid, problem.measure(grid.poses(), np.zeros(3)))


def learn_scattered(problem: Problem, earlier: Fitted | None) -> Fitted:
    offset = Offset.of(problem, earlier)
    count = next(k for k in range(_MOST_NODES, 1, -1) if k**problem.joints <= _MOST_REFERENCES or k == 2)
    nodes = (count,) * problem.joints
    grid = Grid(problem.low, problem.high, nodes)
    rest = problem.x - offset.predict(problem.q)
    smooth = chebyshev_polynomials(nodes)
    design = grid.weights(problem.q) @ smooth
    penalties = roughness(nodes)
    scale = len(rest) * min(_PENALTIES, key=lambda penalty: _held_out_error(design, rest, penalty * penalties))
    return PSOM(grid, smooth @ ridge(design, rest, scale * penalties), offset)


def roughness(nodes: Sequence[int]) -> FloatArray:
    """Return the penalty (size,) of each product of Chebyshev polynomials: the fourth power of its order."""
    orders = np.array(list(product(*(range(count) for count in nodes))), dtype=np.float64)
    return np.square(np.square(orders).sum(axis=1)) + _PENALTY_OF_MEAN


def chebyshev_polynomials(nodes: Sequence[int]) -> FloatArray:
    """Return all products of Chebyshev polynomials of the grid's degrees, at the grid's poses (size, size)."""
    out: FloatArray = np.ones((1, 1))
    for count in nodes:
        values = np.cos(np.arange(count) * np.arccos(chebyshev(count))[:, None])
        out = np.asarray(np.kron(out, values), dtype=np.float64)
    return out


def ridge(design: FloatArray, x: FloatArray, penalties: FloatArray) -> FloatArray:
    """Return coefficients that minimise the squared error plus Σ penalty · coefficient²."""
    if len(design) < design.shape[1]:
        scaled = design / penalties
        coefficients = scaled.T @ np.linalg.solve(scaled @ design.T + np.eye(len(design)), x)
    else:
        coefficients = np.linalg.solve(design.T @ design + np.diag(penalties), design.T @ x)
    return np.asarray(coefficients, dtype=np.float64)


def _held_out_error(design: FloatArray, x: FloatArray, penalties: FloatArray) -> float:
    """Return the squared error on a held-out fifth of the pairs."""
    held = np.arange(len(x)) % _FOLDS == 0
    fitted = ridge(design[~held], x[~held], np.count_nonzero(~held) * penalties)
    return float(np.square(design[held] @ fitted - x[held]).sum())


_MOST_JOINTS_SCATTERED = 8
COMPETITORS = (
    Competitor(
        "psom",
        "PSOM (own grid)",
        "peer",
        learn_on_grid,
        "Parametrised self-organising map (Ritter 1993, Walter 1998): polynomials through readings on a Chebyshev grid "
        "of the working range; n readings at poses of its own choosing.",
        any_of(
            needs_measuring,
            lambda problem: (
                None
                if nodes_for(problem.joints, problem.pairs)
                else f"a grid of 2 poses a joint takes 2^{problem.joints} = {2**problem.joints} readings"
            ),
        ),
    ),
    Competitor(
        "psom+",
        "PSOM+",
        "peer",
        learn_scattered,
        "PSOM+ (Klanke and Ritter 2005): the grid's reference points by least squares with a roughness penalty (chosen "
        "on a fifth held out) from the scattered pairs; learns the errors of the drawing, or of its own model before.",
        at_most(_MOST_JOINTS_SCATTERED, "3^d reference points and more do not fit beyond 8 joints"),
    ),
)
