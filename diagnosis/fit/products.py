"""Form normal equations of many hypotheses, beside a fit and beside that fit without each of its causes.

The columns of a hypothesis are the same in all these places. Only the residuals differ, and the few directions that
only one cause could change; these are freed again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray

from .fit import Fit
from .noise import NoiseSettings

_ROUNDED_OFF = 1e-9  # relative size below which a direction that all others can change is rounding error


@dataclass(frozen=True, eq=False)
class System:
    """Normal equations of m choices of k columns each."""

    inner: FloatArray  # products (m, k, k), after projecting out the fitted parameters
    projections: FloatArray  # products with the directions that the fitted amounts can change (m, k, r)
    rhs: FloatArray  # products with the residuals (m, k, s), in each of the s places
    raw: FloatArray  # squares (m, k) of the unprojected columns
    freed_directions: Sequence[FloatArray]  # directions (r, f) that are freed, in each of the places

    @classmethod
    def of(
        cls, inner: FloatArray, projections: FloatArray, rhs: FloatArray, freed_directions: Sequence[FloatArray]
    ) -> System:
        """Build the system from products (m, k, k) of the unprojected columns."""
        raw = np.einsum("maa->ma", inner).copy()
        return cls(inner - projections @ np.swapaxes(projections, 1, 2), projections, rhs, raw, freed_directions)

    def at(self, place: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return projected products (m, k, k), gradients (m, k) and raw squares (m, k) in a place."""
        free = self.freed_directions[place]
        if not free.shape[1]:
            return self.inner, self.rhs[:, :, place], self.raw
        back = self.projections @ free
        return self.inner + back @ np.swapaxes(back, 1, 2), self.rhs[:, :, place], self.raw


class Products:
    """Products of columns with the directions that a fit can change and with its residuals.

    Args:
        left_out: causes of the fit; each adds a place in which it is absent. The first place is the fit itself.
    """

    def __init__(self, fit: Fit, left_out: Sequence[Effect] = ()) -> None:
        self._fit = fit
        flat = fit.effect_basis.reshape(fit.weighted_residuals.size, -1)
        self.rows = float(fit.noise.weights.sum())  # number of fixes that are the marker
        freed_directions = [np.zeros((flat.shape[1], 0)), *(self._own_directions(cause, flat) for cause in left_out)]
        residuals = np.stack(
            [fit.whitened_residuals.ravel(), *(self._residuals_without(cause) for cause in left_out)], axis=1
        )
        for place, free in enumerate(freed_directions):
            seen = flat.T @ residuals[:, place]
            residuals[:, place] -= flat @ (seen - free @ (free.T @ seen))
        # The simulation's own output leaves no residuals except rounding.
        # sum of squared residuals in each place
        self.squares = np.maximum(np.square(residuals).sum(axis=0), 3.0 * self.rows * NoiseSettings.rounded**2)
        # Tested columns are not `fully_whitened`, as rows are scaled one by one; apply it twice to the rest.
        directions, shares = fit.absorbed_directions
        basis = np.concatenate([directions * np.sqrt(shares), fit.fully_whitened(flat)], axis=1)
        self._basis = basis.reshape(*fit.weighted_residuals.shape, -1)
        self._freed = [np.concatenate([np.zeros((len(shares), free.shape[1])), free]) for free in freed_directions]
        self._residuals = fit.fully_whitened(residuals).reshape(*fit.weighted_residuals.shape, -1)
        self._ports: dict[int, Rows] = {}
        self._kept: dict[tuple[object, ...], System] = {}

    def cached(self, effect: Effect, build: Callable[[], System]) -> System:
        """Return the system of an effect, built on first use."""
        key = (*effect.key, effect.free, effect.values.tobytes())
        if key not in self._kept:
            self._kept[key] = build()
        return self._kept[key]

    def of(self, columns: FloatArray) -> System:
        """Return the system of weighted columns (n, 3, k), as a single choice."""
        flat, left = (
            columns.reshape(self._fit.weighted_residuals.size, -1),
            self._residuals.reshape(self._fit.weighted_residuals.size, -1),
        )
        projections = flat.T @ self._basis.reshape(len(flat), -1)
        return System.of((flat.T @ flat)[None], projections[None], (flat.T @ left)[None], self._freed)

    def joint_rows(self, joint: int) -> Rows:
        """Return the derivative of the weighted prediction with respect to a joint, row by row."""
        if joint not in self._ports:
            self._ports[joint] = self.rows_of(self._fit.weighted(self._fit.run.by_joint[:, :, [joint]]))
        return self._ports[joint]

    def step_systems(self, columns: FloatArray, moments: range) -> System:
        """Return systems of weighted columns (n, 3, k) that begin at each of some rows, all of them before the end."""
        parts = [columns, self._basis, self._residuals]
        step, last = moments.step, moments[-1]
        between = [part[moments[0] : last].reshape(len(moments) - 1, 3 * step, -1) for part in parts]
        rest = [part[last:].reshape(1, 3 * (len(columns) - last), -1) for part in parts]
        turned = [np.swapaxes(rows[0], 1, 2) for rows in (between, rest)]
        sums = [np.concatenate([turned[0] @ between[k], turned[1] @ rest[k]]) for k in range(3)]
        inner, projections, rhs = (np.cumsum(part[::-1], axis=0)[::-1] for part in sums)
        return System.of(inner, projections, rhs, self._freed)

    def rows_of(self, columns: FloatArray) -> Rows:
        """Return the contribution of each row of weighted columns (n, 3, k)."""
        turned = np.swapaxes(columns, 1, 2)
        return Rows(turned @ columns, turned @ self._basis, turned @ self._residuals, self._freed)

    def _residuals_without(self, cause: Effect) -> FloatArray:
        """Return the residuals (3 n,) without a cause, all others unchanged, weighted and `fully_whitened`."""
        fit = self._fit
        others = [effect for effect in fit.simulation.effects if effect is not cause]
        return fit.whitened_residuals_of(fit.simulation.with_effects(others).positions(fit.observations.motion)).ravel()

    def _own_directions(self, cause: Effect, flat: FloatArray) -> FloatArray:
        """Return the directions (r, f) of the basis (3 n, r) that no other effect can change."""
        places = set(self._fit.places(cause))
        columns = self._fit.effect_columns.reshape(len(flat), -1)
        others = [k for k in range(columns.shape[1]) if k not in places]
        seen = flat.T @ self._fit.fully_whitened(columns[:, others])
        seen = seen / np.maximum(np.linalg.norm(seen, axis=0), 1e-300)
        left_vectors, values, _ = np.linalg.svd(seen)
        return left_vectors[:, int((values > _ROUNDED_OFF * values.max(initial=0.0)).sum()) :]


@dataclass(frozen=True, eq=False)
class Rows:
    """Contributions of each row to the normal equations of columns (n, 3, k)."""

    inner: FloatArray  # products with one another (n, k, k)
    projections: FloatArray  # products with the directions that the fitted amounts can change (n, k, r)
    rhs: FloatArray  # products with the residuals (n, k, s), in each of the places
    freed_directions: Sequence[FloatArray]  # as in `System`

    def scaled(self, factors: FloatArray) -> System:
        """Return the system of rows times factors (n, m)."""
        return System.of(
            _summed(np.square(factors), self.inner),
            _summed(factors, self.projections),
            _summed(factors, self.rhs),
            self.freed_directions,
        )

    def mixed(self, factors: FloatArray) -> System:
        """Return the system of k columns, each this single column times factors (n, k), row by row."""
        inner = factors.T @ (self.inner[:, 0] * factors)
        return System.of(
            inner[None],
            (factors.T @ self.projections[:, 0])[None],
            (factors.T @ self.rhs[:, 0])[None],
            self.freed_directions,
        )

    def modulated(self, waves: NDArray[np.complex128]) -> System:
        """Return the system of this single column times sine and cosine of waves (n, m)."""
        count, square = waves.shape[1], self.inner[:, 0, 0]
        doubled = square @ np.square(waves)
        inner = np.empty((count, 2, 2))
        inner[:, 0, 0], inner[:, 1, 1] = 0.5 * (square.sum() - doubled.real), 0.5 * (square.sum() + doubled.real)
        inner[:, 0, 1] = inner[:, 1, 0] = 0.5 * doubled.imag
        # Cosines and sines alternate.
        flat = waves.view(np.float64)
        projections, rhs = (
            (flat.T @ part[:, 0]).reshape(count, 2, part.shape[2])[:, ::-1] for part in (self.projections, self.rhs)
        )
        return System.of(inner, projections, rhs, self.freed_directions)


def _summed(factors: FloatArray, rows: FloatArray) -> FloatArray:
    """Return sums (m, ...) of rows (n, ...) times factors (n, m)."""
    return (factors.T @ rows.reshape(len(rows), -1)).reshape(factors.shape[1], *rows.shape[1:])
