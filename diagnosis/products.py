"""Normal equations of many hypotheses beside what a fit has, and beside what it has without one of its causes.

The columns of a hypothesis are the same in all these places. What differs is what is left, and the few directions that
a cause alone could change: they are given back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray

from .fit import ROUNDED, Fit

# Of directions that all others can change, too, a smaller part than this is rounding.
_ROUNDED_OFF = 1e-9


@dataclass(frozen=True, eq=False)
class System:
    """Normal equations of m choices of k columns each.

    Attributes:
        inner: products (m, k, k) beside all that is fitted.
        onto: with what the fitted amounts can change (m, k, r).
        toward: with what is left (m, k, s), in each of the s places.
        raw: squares (m, k) of the columns themselves.
        freed: which directions (r, f) are given back, in each of the places.
    """

    inner: FloatArray
    onto: FloatArray
    toward: FloatArray
    raw: FloatArray
    freed: Sequence[FloatArray]

    @classmethod
    def of(cls, inner: FloatArray, onto: FloatArray, toward: FloatArray, freed: Sequence[FloatArray]) -> System:
        """From products (m, k, k) of the columns themselves."""
        raw = np.einsum("maa->ma", inner).copy()
        return cls(inner - onto @ np.swapaxes(onto, 1, 2), onto, toward, raw, freed)

    def at(self, place: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Inner products (m, k, k) beside what is fitted, gradients (m, k) and raw squares (m, k) in a place."""
        free = self.freed[place]
        if not free.shape[1]:
            return self.inner, self.toward[:, :, place], self.raw
        back = self.onto @ free
        return self.inner + back @ np.swapaxes(back, 1, 2), self.toward[:, :, place], self.raw


class Products:
    """Products of columns with what a fit can change and with what it leaves.

    Args:
        besides: causes of the fit; each is a place of its own, in which it is not there. The fit itself is the first.

    Attributes:
        rows: how many fixes are the marker.
        squares: sum of the squares that are left in each place.
    """

    def __init__(self, fit: Fit, besides: Sequence[Effect] = ()) -> None:
        self._fit = fit
        flat = fit.orthogonal.reshape(fit.left.size, -1)
        self.rows = float(fit.noise.weights.sum())
        freed = [np.zeros((flat.shape[1], 0)), *(self._only_of(cause, flat) for cause in besides)]
        lefts = np.stack([fit.evident.ravel(), *(self._left_without(cause) for cause in besides)], axis=1)
        for place, free in enumerate(freed):
            seen = flat.T @ lefts[:, place]
            lefts[:, place] -= flat @ (seen - free @ (free.T @ seen))
        # A simulation's own output leaves nothing, or what is rounded.
        self.squares = np.maximum(np.square(lefts).sum(axis=0), 3.0 * self.rows * ROUNDED**2)
        # What is tested is not `unshared` itself, as its rows are scaled one by one: all else is, twice.
        directions, shares = fit.absorbed
        basis = np.concatenate([directions * np.sqrt(shares), fit.unshared(flat)], axis=1)
        self._basis = basis.reshape(*fit.left.shape, -1)
        self._freed = [np.concatenate([np.zeros((len(shares), free.shape[1])), free]) for free in freed]
        self._lefts = fit.unshared(lefts).reshape(*fit.left.shape, -1)
        self._ports: dict[int, Rows] = {}
        self._kept: dict[tuple[object, ...], System] = {}

    def kept(self, effect: Effect, made: Callable[[], System]) -> System:
        """The system of an effect; it is made where it is not known yet."""
        key = (*effect.key, effect.values.tobytes())
        if key not in self._kept:
            self._kept[key] = made()
        return self._kept[key]

    def of(self, columns: FloatArray) -> System:
        """Of weighted columns (n, 3, k), which are one choice."""
        flat, left = columns.reshape(self._fit.left.size, -1), self._lefts.reshape(self._fit.left.size, -1)
        onto = flat.T @ self._basis.reshape(len(flat), -1)
        return System.of((flat.T @ flat)[None], onto[None], (flat.T @ left)[None], self._freed)

    def port(self, joint: int) -> Rows:
        """How the weighted prediction moves with a joint."""
        if joint not in self._ports:
            self._ports[joint] = self.rows_of(self._fit.weighted(self._fit.run.by_joint[:, :, [joint]]))
        return self._ports[joint]

    def since(self, columns: FloatArray, moments: range) -> System:
        """Of weighted columns (n, 3, k) from each of some rows on, the last of which is before the end."""
        parts = [columns, self._basis, self._lefts]
        step, last = moments.step, moments[-1]
        between = [part[moments[0] : last].reshape(len(moments) - 1, 3 * step, -1) for part in parts]
        rest = [part[last:].reshape(1, 3 * (len(columns) - last), -1) for part in parts]
        turned = [np.swapaxes(rows[0], 1, 2) for rows in (between, rest)]
        sums = [np.concatenate([turned[0] @ between[k], turned[1] @ rest[k]]) for k in range(3)]
        inner, onto, toward = (np.cumsum(part[::-1], axis=0)[::-1] for part in sums)
        return System.of(inner, onto, toward, self._freed)

    def rows_of(self, columns: FloatArray) -> Rows:
        """What each row of weighted columns (n, 3, k) adds."""
        turned = np.swapaxes(columns, 1, 2)
        return Rows(turned @ columns, turned @ self._basis, turned @ self._lefts, self._freed)

    def _left_without(self, cause: Effect) -> FloatArray:
        """What is left (3 n,) without a cause, all others as they are, weighted and `unshared`."""
        fit = self._fit
        others = [effect for effect in fit.simulation.effects if effect is not cause]
        return fit.left_by(fit.simulation.with_effects(others).positions(fit.observations.motion)).ravel()

    def _only_of(self, cause: Effect, flat: FloatArray) -> FloatArray:
        """The directions (r, f) of the basis (3 n, r) that no other effect can change."""
        places = set(self._fit.places(cause))
        columns = self._fit.effect_columns.reshape(len(flat), -1)
        others = [k for k in range(columns.shape[1]) if k not in places]
        seen = flat.T @ self._fit.unshared(columns[:, others])
        seen = seen / np.maximum(np.linalg.norm(seen, axis=0), 1e-300)
        left, values, _ = np.linalg.svd(seen)
        return left[:, int((values > _ROUNDED_OFF * values.max(initial=0.0)).sum()) :]


@dataclass(frozen=True, eq=False)
class Rows:
    """What each row adds to the normal equations of columns (n, 3, k).

    Attributes:
        inner: products with one another (n, k, k).
        onto: with what the fitted amounts can change (n, k, r).
        toward: with what is left (n, k, s), in each of the places.
        freed: as `System` has them.
    """

    inner: FloatArray
    onto: FloatArray
    toward: FloatArray
    freed: Sequence[FloatArray]

    def scaled(self, factors: FloatArray) -> System:
        """Of rows times factors (n, m)."""
        return System.of(
            _summed(np.square(factors), self.inner),
            _summed(factors, self.onto),
            _summed(factors, self.toward),
            self.freed,
        )

    def mixed(self, factors: FloatArray) -> System:
        """The one system of k columns that are each this single column times factors (n, k), row by row."""
        inner = factors.T @ (self.inner[:, 0] * factors)
        return System.of(
            inner[None], (factors.T @ self.onto[:, 0])[None], (factors.T @ self.toward[:, 0])[None], self.freed
        )

    def waved(self, waves: NDArray[np.complex128]) -> System:
        """Of sine and cosine of each of some waves (n, m), by which this single column is multiplied."""
        count, square = waves.shape[1], self.inner[:, 0, 0]
        doubled = square @ np.square(waves)
        inner = np.empty((count, 2, 2))
        inner[:, 0, 0], inner[:, 1, 1] = 0.5 * (square.sum() - doubled.real), 0.5 * (square.sum() + doubled.real)
        inner[:, 0, 1] = inner[:, 1, 0] = 0.5 * doubled.imag
        # Cosines and sines take turns.
        flat = waves.view(np.float64)
        onto, toward = (
            (flat.T @ part[:, 0]).reshape(count, 2, part.shape[2])[:, ::-1] for part in (self.onto, self.toward)
        )
        return System.of(inner, onto, toward, self.freed)


def _summed(factors: FloatArray, rows: FloatArray) -> FloatArray:
    """Sums (m, ...) of rows (n, ...) times factors (n, m)."""
    return (factors.T @ rows.reshape(len(rows), -1)).reshape(factors.shape[1], *rows.shape[1:])
