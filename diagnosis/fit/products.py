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
    onto: FloatArray  # products with the directions that the fitted amounts can change (m, k, r)
    toward: FloatArray  # products with the residuals (m, k, s), in each of the s places
    raw: FloatArray  # squares (m, k) of the unprojected columns
    freed: Sequence[FloatArray]  # directions (r, f) that are freed, in each of the places

    @classmethod
    def of(cls, inner: FloatArray, onto: FloatArray, toward: FloatArray, freed: Sequence[FloatArray]) -> System:
        """Build the system from products (m, k, k) of the unprojected columns."""
        raw = np.einsum("maa->ma", inner).copy()
        return cls(inner - onto @ np.swapaxes(onto, 1, 2), onto, toward, raw, freed)

    def at(self, place: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return projected products (m, k, k), gradients (m, k) and raw squares (m, k) in a place."""
        free = self.freed[place]
        if not free.shape[1]:
            return self.inner, self.toward[:, :, place], self.raw
        back = self.onto @ free
        return self.inner + back @ np.swapaxes(back, 1, 2), self.toward[:, :, place], self.raw


class Products:
    """Products of columns with the directions that a fit can change and with its residuals.

    Args:
        besides: causes of the fit; each adds a place in which it is absent. The first place is the fit itself.
    """

    def __init__(self, fit: Fit, besides: Sequence[Effect] = ()) -> None:
        self._fit = fit
        flat = fit.orthogonal.reshape(fit.left.size, -1)
        self.rows = float(fit.noise.weights.sum())  # number of fixes that are the marker
        freed = [np.zeros((flat.shape[1], 0)), *(self._only_of(cause, flat) for cause in besides)]
        lefts = np.stack([fit.evident.ravel(), *(self._left_without(cause) for cause in besides)], axis=1)
        for place, free in enumerate(freed):
            seen = flat.T @ lefts[:, place]
            lefts[:, place] -= flat @ (seen - free @ (free.T @ seen))
        # The simulation's own output leaves no residuals except rounding.
        # sum of squared residuals in each place
        self.squares = np.maximum(np.square(lefts).sum(axis=0), 3.0 * self.rows * NoiseSettings.rounded**2)
        # Tested columns are not `unshared`, since their rows are scaled one by one; apply it twice to the rest instead.
        directions, shares = fit.absorbed
        basis = np.concatenate([directions * np.sqrt(shares), fit.unshared(flat)], axis=1)
        self._basis = basis.reshape(*fit.left.shape, -1)
        self._freed = [np.concatenate([np.zeros((len(shares), free.shape[1])), free]) for free in freed]
        self._lefts = fit.unshared(lefts).reshape(*fit.left.shape, -1)
        self._ports: dict[int, Rows] = {}
        self._kept: dict[tuple[object, ...], System] = {}

    def kept(self, effect: Effect, made: Callable[[], System]) -> System:
        """Return the system of an effect, built on first use."""
        key = (*effect.key, effect.free, effect.values.tobytes())
        if key not in self._kept:
            self._kept[key] = made()
        return self._kept[key]

    def of(self, columns: FloatArray) -> System:
        """Return the system of weighted columns (n, 3, k), as a single choice."""
        flat, left = columns.reshape(self._fit.left.size, -1), self._lefts.reshape(self._fit.left.size, -1)
        onto = flat.T @ self._basis.reshape(len(flat), -1)
        return System.of((flat.T @ flat)[None], onto[None], (flat.T @ left)[None], self._freed)

    def port(self, joint: int) -> Rows:
        """Return the derivative of the weighted prediction with respect to a joint, row by row."""
        if joint not in self._ports:
            self._ports[joint] = self.rows_of(self._fit.weighted(self._fit.run.by_joint[:, :, [joint]]))
        return self._ports[joint]

    def since(self, columns: FloatArray, moments: range) -> System:
        """Return systems of weighted columns (n, 3, k) that begin at each of some rows, all of them before the end."""
        parts = [columns, self._basis, self._lefts]
        step, last = moments.step, moments[-1]
        between = [part[moments[0] : last].reshape(len(moments) - 1, 3 * step, -1) for part in parts]
        rest = [part[last:].reshape(1, 3 * (len(columns) - last), -1) for part in parts]
        turned = [np.swapaxes(rows[0], 1, 2) for rows in (between, rest)]
        sums = [np.concatenate([turned[0] @ between[k], turned[1] @ rest[k]]) for k in range(3)]
        inner, onto, toward = (np.cumsum(part[::-1], axis=0)[::-1] for part in sums)
        return System.of(inner, onto, toward, self._freed)

    def rows_of(self, columns: FloatArray) -> Rows:
        """Return the contribution of each row of weighted columns (n, 3, k)."""
        turned = np.swapaxes(columns, 1, 2)
        return Rows(turned @ columns, turned @ self._basis, turned @ self._lefts, self._freed)

    def _left_without(self, cause: Effect) -> FloatArray:
        """Return the residuals (3 n,) without a cause, all others unchanged, weighted and `unshared`."""
        fit = self._fit
        others = [effect for effect in fit.simulation.effects if effect is not cause]
        return fit.left_by(fit.simulation.with_effects(others).positions(fit.observations.motion)).ravel()

    def _only_of(self, cause: Effect, flat: FloatArray) -> FloatArray:
        """Return the directions (r, f) of the basis (3 n, r) that no other effect can change."""
        places = set(self._fit.places(cause))
        columns = self._fit.effect_columns.reshape(len(flat), -1)
        others = [k for k in range(columns.shape[1]) if k not in places]
        seen = flat.T @ self._fit.unshared(columns[:, others])
        seen = seen / np.maximum(np.linalg.norm(seen, axis=0), 1e-300)
        left, values, _ = np.linalg.svd(seen)
        return left[:, int((values > _ROUNDED_OFF * values.max(initial=0.0)).sum()) :]


@dataclass(frozen=True, eq=False)
class Rows:
    """Contributions of each row to the normal equations of columns (n, 3, k)."""

    inner: FloatArray  # products with one another (n, k, k)
    onto: FloatArray  # products with the directions that the fitted amounts can change (n, k, r)
    toward: FloatArray  # products with the residuals (n, k, s), in each of the places
    freed: Sequence[FloatArray]  # as in `System`

    def scaled(self, factors: FloatArray) -> System:
        """Return the system of rows times factors (n, m)."""
        return System.of(
            _summed(np.square(factors), self.inner),
            _summed(factors, self.onto),
            _summed(factors, self.toward),
            self.freed,
        )

    def mixed(self, factors: FloatArray) -> System:
        """Return the system of k columns, each this single column times factors (n, k), row by row."""
        inner = factors.T @ (self.inner[:, 0] * factors)
        return System.of(
            inner[None], (factors.T @ self.onto[:, 0])[None], (factors.T @ self.toward[:, 0])[None], self.freed
        )

    def waved(self, waves: NDArray[np.complex128]) -> System:
        """Return the system of this single column times sine and cosine of waves (n, m)."""
        count, square = waves.shape[1], self.inner[:, 0, 0]
        doubled = square @ np.square(waves)
        inner = np.empty((count, 2, 2))
        inner[:, 0, 0], inner[:, 1, 1] = 0.5 * (square.sum() - doubled.real), 0.5 * (square.sum() + doubled.real)
        inner[:, 0, 1] = inner[:, 1, 0] = 0.5 * doubled.imag
        # Cosines and sines alternate.
        flat = waves.view(np.float64)
        onto, toward = (
            (flat.T @ part[:, 0]).reshape(count, 2, part.shape[2])[:, ::-1] for part in (self.onto, self.toward)
        )
        return System.of(inner, onto, toward, self.freed)


def _summed(factors: FloatArray, rows: FloatArray) -> FloatArray:
    """Return sums (m, ...) of rows (n, ...) times factors (n, m)."""
    return (factors.T @ rows.reshape(len(rows), -1)).reshape(factors.shape[1], *rows.shape[1:])
