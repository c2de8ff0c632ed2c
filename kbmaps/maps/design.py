"""Pairs of a least-squares problem, and products with its matrix, which is never formed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.contraction import contracted
from kbmaps.maps.factor import RowFactor
from kbmaps.maps.stack import BasisStack

_BLOCK = 512  # number of pairs whose weights are formed at once
# Products w_a w_b of one joint, each pair once; with these factors their norm is that of the full matrix w wᵀ.
_FIRST, _SECOND = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
_FACTORS = np.array([1.0, 1.0, 1.0, *[math.sqrt(2.0)] * 3])


class Moments:
    """Sums over pairs from which the Gram matrix Σ weight · w wᵀ is unfolded. Inputs are not checked."""

    def __init__(self, bases: Sequence[JointBasis], stack: BasisStack) -> None:
        self._stack = stack
        self._polynomials = [_polynomials(basis) for basis in bases]
        self._sizes = [table.shape[1] for table in self._polynomials]
        left, right = self._sizes[: stack.split], self._sizes[stack.split :]
        self._sums = np.zeros((math.prod(left), math.prod(right)))

    def add(self, q: FloatArray, weights: FloatArray) -> None:
        """Add pairs at q (n, d) of weights (n,)."""
        for start in range(0, len(q), _BLOCK):
            part = slice(start, start + _BLOCK)
            w = self._stack.joint_weights(q[part])
            products = w[:, :, _FIRST] * w[:, :, _SECOND] * _FACTORS
            features = [products[:, k] @ table for k, table in enumerate(self._polynomials)]
            left = _kronecker([weights[part, None], *features[: self._stack.split]])
            self._sums += left.T @ _kronecker([np.ones((len(w), 1)), *features[self._stack.split :]])

    def scale(self, weight: float) -> None:
        """Multiply the weight of all pairs so far."""
        self._sums *= weight

    def clear(self) -> None:
        """Forget all pairs."""
        self._sums[:] = 0.0

    def gram(self) -> FloatArray:
        """Return a new Gram matrix (m, m), Fortran-ordered; only its upper triangle is valid."""
        stack, split = self._stack, self._stack.split
        left = self._unfolded(np.eye(len(self._sums)), 0, split)
        right = self._unfolded(self._sums, split, stack.joints)
        gram = np.empty((stack.left_size, stack.right_size, stack.left_size, stack.right_size))
        for row, by_moment in enumerate(left):
            # Blocks of the lower triangle in C order are the upper one in Fortran order, since each is symmetric.
            np.matmul(by_moment[:, : row + 1].T, right, out=gram[row, :, : row + 1])
        return gram.reshape(self._stack.left_size * self._stack.right_size, -1).T

    def _unfolded(self, sums: FloatArray, begin: int, end: int) -> FloatArray:
        """Return moments (rows, those of the joints begin..end) as sums of w_a w_b (a, rows, b)."""
        rows, sizes = len(sums), self._stack.sizes[begin:end]
        unfolded = sums
        for k in reversed(range(begin, end)):
            table = _full_products(self._polynomials[k], self._stack.sizes[k])
            done = math.prod(size * size for size in self._stack.sizes[k + 1 : end])
            unfolded = table @ unfolded.reshape(-1, table.shape[1], done)
        paired = unfolded.reshape(rows, *(size for size in sizes for _ in range(2)))
        joints = range(1, 2 * len(sizes), 2)
        in_order = paired.transpose(*joints, 0, *(place + 1 for place in joints))
        return np.ascontiguousarray(in_order).reshape(math.prod(sizes), rows, math.prod(sizes))


def _polynomials(basis: JointBasis) -> FloatArray:
    """Return orthonormal combinations (6, 5) of the products w_a w_b that span them all; (6, 3) for a prismatic joint.

    With u = w @ mix⁻¹ = (first², first · second, second²), a revolute joint's products obey one relation,
    u_0 u_2 = u_1². The space orthogonal to it loses nothing, and an orthonormal basis amplifies no rounding.
    """
    if basis.is_prismatic:
        return np.eye(6)[:, [0, 1, 3]]
    inverse = np.linalg.inv(basis.terms.mix)
    relation = inverse @ np.array([[0.0, 0.0, 0.5], [0.0, -1.0, 0.0], [0.5, 0.0, 0.0]]) @ inverse.T
    vector = relation[_FIRST, _SECOND] * _FACTORS
    return np.linalg.svd(vector[None])[2][1:].T


def _full_products(polynomials: FloatArray, size: int) -> FloatArray:
    """Return all products w_a w_b (size², polynomials) of a joint's functions from its polynomials."""
    full = np.empty((3, 3, polynomials.shape[1]))
    full[_FIRST, _SECOND] = polynomials / _FACTORS[:, None]
    full[_SECOND, _FIRST] = full[_FIRST, _SECOND]
    return full[:size, :size].reshape(size * size, -1)


def _kronecker(factors: Sequence[FloatArray]) -> FloatArray:
    """Return row-wise Kronecker products: (n, product of the widths)."""
    product = factors[-1]
    for factor in reversed(factors[:-1]):
        product = (factor[:, :, None] * product[:, None, :]).reshape(len(product), -1)
    return product


class Design:
    """Matrix A (n, m) with the rows √weight · w(q)ᵀ, and the targets (n, outputs) scaled in the same way.

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
        self._table = np.empty((_BLOCK, self._stack.joints + outputs + 1))
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
