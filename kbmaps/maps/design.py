"""Pairs of a least-squares problem, and products with its matrix, which is never formed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.contraction import contracted
from kbmaps.maps.factor import RowFactor
from kbmaps.maps.moments import Moments
from kbmaps.maps.stack import BasisStack

_BLOCK = 512
_FIRST_CAPACITY = 256


class Design:
    """Matrix A (n, m) with the rows √weight · w(q)ᵀ, and the targets (n, outputs) likewise scaled.

    A pair takes (d + outputs + 1) numbers, and a product with A costs as much as predictions; w(q) is a Kronecker
    product and never formed. The sums for AᵀA are updated block by block once there are more pairs than unknowns.
    Inputs are not checked.
    """

    def __init__(self, bases: Sequence[JointBasis], outputs: int) -> None:
        self._stack = BasisStack(bases)
        self.unknowns = self._stack.left_size * self._stack.right_size
        self.outputs = outputs
        self._moments = Moments(bases, self._stack)
        self._in_moments = self._left_moments = 0
        self._table = np.empty((_FIRST_CAPACITY, self._stack.joints + outputs + 1))
        self._pairs = 0

    def __len__(self) -> int:
        return self._pairs

    @property
    def overdetermined(self) -> bool:
        """True if there are more pairs than unknowns."""
        return self._pairs > self.unknowns

    def add(self, q: FloatArray, targets: FloatArray, weights: FloatArray) -> None:
        """Add pairs q (n, d), targets (n, outputs), of weights (n,)."""
        end = self._pairs + len(q)
        if end > len(self._table):
            grown = np.empty((max(end, 2 * len(self._table)), self._table.shape[1]))
            grown[: self._pairs] = self._table[: self._pairs]
            self._table = grown
        new, joints = self._table[self._pairs : end], self._stack.joints
        roots = np.sqrt(weights)[:, None]
        new[:, :joints], new[:, joints:-1], new[:, -1:] = q, targets * roots, roots
        self._pairs = end
        if self.overdetermined and end - self._in_moments >= _BLOCK:
            self._update_moments()

    def fade(self, weight: float) -> None:
        """Multiply the weight of all pairs so far by a factor in 0..1."""
        self._table[: self._pairs, self._stack.joints :] *= math.sqrt(weight)
        self._moments.scale(weight)

    def keep(self, count: int) -> None:
        """Drop all but the last `count` pairs."""
        gone = self._pairs - count
        if gone <= 0:
            return
        counted = min(gone, self._in_moments)
        self._moments.add(self._table[:counted, : self._stack.joints], -np.square(self._table[:counted, -1]))
        self._table[:count] = self._table[gone : self._pairs].copy()
        self._pairs, self._in_moments = count, self._in_moments - counted
        self._left_moments += counted
        if self._left_moments > max(count, _BLOCK):
            # Adding and subtracting the same terms leaves rounding errors behind.
            self._moments.clear()
            self._in_moments = self._left_moments = 0

    def errors(self, coefficients: FloatArray) -> FloatArray:
        """Return targets − A @ coefficients (m, outputs): (n, outputs)."""
        return self._table[: self._pairs, self._stack.joints : -1] - self.times(coefficients)

    def times(self, coefficients: FloatArray) -> FloatArray:
        """Return A @ coefficients (m, outputs): (n, outputs)."""
        planes = coefficients.T.reshape(-1, self._stack.right_size)
        product = np.empty((self._pairs, self.outputs))
        for part, left, right in self._blocks():
            product[part] = contracted(planes, left, right)
        return product

    def transposed_times(self, values: FloatArray) -> FloatArray:
        """Return Aᵀ @ values (n, outputs): (m, outputs)."""
        planes = np.zeros((self.outputs * self._stack.left_size, self._stack.right_size))
        for part, left, right in self._blocks():
            by_output = values[part].T[:, None, :] * left.T
            planes += by_output.reshape(-1, len(left)) @ right
        return planes.reshape(self.outputs, -1).T

    def gram(self) -> FloatArray:
        """Return a new AᵀA (m, m) if overdetermined, else A Aᵀ (n, n); Fortran-ordered, the upper triangle counts."""
        if self.overdetermined:
            self._update_moments()
            return self._moments.gram()
        left, right = self._all_halves()
        kernel = np.empty((self._pairs, self._pairs))
        for start in range(0, self._pairs, _BLOCK):
            part = slice(start, start + _BLOCK)
            # The kernel of two pairs is a product over the joints.
            np.multiply(left[part] @ left.T, right[part] @ right.T, out=kernel[part])
        return kernel.T

    def rows(self) -> FloatArray:
        """Return A itself (n, m)."""
        left, right = self._all_halves()
        return (left[:, :, None] * right[:, None, :]).reshape(self._pairs, -1)

    def factor(self, errors: FloatArray) -> RowFactor:
        """Return A and the errors (n, outputs) as triangular QR factors. Slow: see `RowFactor`."""
        factor = RowFactor(self.unknowns, self.outputs)
        for part, left, right in self._blocks():
            factor.add((left[:, :, None] * right[:, None, :]).reshape(len(left), -1), errors[part])
        return factor

    def _blocks(self) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Yield blocks of rows, with the scaled left and the right halves of their weights."""
        for start in range(0, self._pairs, _BLOCK):
            part = slice(start, min(start + _BLOCK, self._pairs))
            left, right = self._stack.halves(self._table[part, : self._stack.joints])
            yield part, left * self._table[part, -1:], right

    def _all_halves(self) -> tuple[FloatArray, FloatArray]:
        left, right = self._stack.halves(self._table[: self._pairs, : self._stack.joints])
        return left * self._table[: self._pairs, -1:], right

    def _update_moments(self) -> None:
        new = self._table[self._in_moments : self._pairs]
        self._moments.add(new[:, : self._stack.joints], np.square(new[:, -1]))
        self._in_moments = self._pairs
