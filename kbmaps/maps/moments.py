"""Gram matrix of a Kinematic Bézier Map from 5^d moments instead of its 3^d · 3^d entries.

The product of two functions of a revolute joint is a trigonometric polynomial of degree two, and these have five
dimensions. So every entry Σ_n w_a(q_n) w_b(q_n) of the Gram matrix is a combination of the 5^d sums of products of
one such polynomial per joint: 78,125 numbers at seven joints, where the matrix has 4.8 million.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.stack import BasisStack

_BLOCK = 256
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
        """Return a new Gram matrix (m, m), Fortran-ordered, of which only the upper triangle counts."""
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
