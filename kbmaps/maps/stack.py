"""Bases of all joints together: weight vectors as Kronecker products of two halves of the joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.maps.basis import JointBasis

# The three products of the two sines of a joint: first², first · second, second².
_FIRST, _SECOND = np.array([[0, 0, 1], [0, 1, 1]])


class BasisStack:
    """Evaluator of all joints at once that keeps the weight vector factored into a left and a right half.

    The full weight vector is kron(left, right). With about as many joints on either side, both are of length 3^(d/2),
    so contracting a net of 3^d control points with them needs no vector of length 3^d. Inputs are not checked: callers
    validate them.
    """

    def __init__(self, bases: Sequence[JointBasis]) -> None:
        self.sizes = tuple(basis.size for basis in bases)
        self.joints = len(self.sizes)
        self.split = self.joints // 2
        self.left_size = math.prod(self.sizes[: self.split])
        self.right_size = math.prod(self.sizes[self.split :])
        self._half_phases = np.array([basis.terms.phases for basis in bases]).T * 0.5
        self._slides = np.array([basis.is_prismatic for basis in bases])
        self._any_slides = bool(self._slides.any())
        self._start, self._span = self._half_phases * 2.0
        self._mix = np.zeros((self.joints, 3, 3))
        for k, basis in enumerate(bases):
            self._mix[k, : basis.size, : basis.size] = basis.terms.mix
        # One matrix product for all joints: products (3, d), flattened, to weights (d, 3), flattened.
        self._mix_all = np.zeros((3, self.joints, self.joints, 3))
        for k in range(self.joints):
            self._mix_all[:, k, k] = self._mix[k]
        self._mix_all = self._mix_all.reshape(3 * self.joints, 3 * self.joints)

    @property
    def tables(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Constant inputs of `joint_weights`. Half phases (2, d), mixing matrices (d, 3, 3), 1 where prismatic (d,)."""
        return np.ascontiguousarray(self._half_phases), self._mix, self._slides.astype(np.float64)

    # Tables of 3^(d/2) entries per joint, built on first use: a tensor train of 30 joints does not need them.
    @cached_property
    def _left_index(self) -> IntArray:
        return _factor_index(self.sizes[: self.split], 0)

    @cached_property
    def _right_index(self) -> IntArray:
        return _factor_index(self.sizes[self.split :], self.split)

    @cached_property
    def _halves_index(self) -> IntArray:
        """Both indices side by side; the side of fewer joints is padded with the entry after the last weight, a 1."""
        factors = self.joints - self.split
        index = np.full((factors, self.left_size + self.right_size), 3 * self.joints, dtype=np.intp)
        index[: self.split, : self.left_size] = self._left_index
        index[:, self.left_size :] = self._right_index
        return index

    def joint_weights(self, q: FloatArray) -> FloatArray:
        """Return basis functions (..., d, 3) of every joint for q (..., d); a prismatic joint's third entry is 0."""
        return (self._products(q) @ self._mix_all).reshape(*q.shape, 3)

    def joint_derivatives(self, q: FloatArray) -> FloatArray:
        """Return derivatives (..., d, 3) of the basis functions of every joint."""
        first, second = self._half_phases
        phases = np.stack([2.0 * first, first + second, 2.0 * second])
        products = 0.5 * np.sin(q[..., None, :] - phases)
        if self._any_slides:
            slope = np.broadcast_to(1.0 / self._span, q.shape)
            stroke = np.stack([-slope, slope, np.zeros_like(slope)], axis=-2)
            products = np.where(self._slides, stroke, products)
        return (products.reshape(*q.shape[:-1], -1) @ self._mix_all).reshape(*q.shape, 3)

    def _products(self, q: FloatArray) -> FloatArray:
        """Return the three products (..., 3 d) that the basis functions are mixed from, as in `basis.Terms`."""
        if q.ndim > 1:
            return self._products_of_rows(q.reshape(-1, self.joints).T).T.reshape(*q.shape[:-1], 3 * self.joints)
        sines = np.sin(0.5 * q - self._half_phases)
        products = sines.take(_FIRST, axis=-2) * sines.take(_SECOND, axis=-2)
        if self._any_slides:
            share = (q - self._start) / self._span
            products = np.where(self._slides, np.stack([1.0 - share, share, np.zeros_like(share)]), products)
        return products.reshape(-1)

    def _products_of_rows(self, q: FloatArray) -> FloatArray:
        """Return `_products` (3 d, n) for many rows, transposed, q (d, n): the inner loops then run over the rows."""
        sines = np.sin(0.5 * q - self._half_phases[:, :, None])
        products = np.empty((3, *q.shape))
        for place, (first, second) in enumerate(((0, 0), (0, 1), (1, 1))):
            np.multiply(sines[first], sines[second], out=products[place])
        if self._any_slides:
            share = (q - self._start[:, None]) / self._span[:, None]
            stroke = np.stack([1.0 - share, share, np.zeros_like(share)])
            products = np.where(self._slides[:, None], stroke, products)
        return products.reshape(3 * self.joints, q.shape[1])

    def halves(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return left (left_size,) and right (right_size,) weights for q (d,); for q (n, d) with a leading n."""
        if q.ndim > 1:
            weights = self.joint_weights(q)
            return self.left(weights), self.right(weights)
        weights_and_one = np.empty(3 * self.joints + 1)
        weights_and_one[-1] = 1.0
        np.dot(self._products(q), self._mix_all, out=weights_and_one[:-1])
        both = np.multiply.reduce(weights_and_one.take(self._halves_index), axis=0)
        return both[: self.left_size], both[self.left_size :]

    def left(self, weights: FloatArray) -> FloatArray:
        """Return the left half's Kronecker product of joint weights (..., d, 3)."""
        if weights.ndim == 2:
            return np.multiply.reduce(weights.take(self._left_index), axis=0)
        return self._kronecker(weights, 0, self.split)

    def right(self, weights: FloatArray) -> FloatArray:
        """Return the right half's Kronecker product of joint weights (..., d, 3)."""
        if weights.ndim == 2:
            return np.multiply.reduce(weights.take(self._right_index), axis=0)
        return self._kronecker(weights, self.split, self.joints)

    def full(self, q: FloatArray) -> FloatArray:
        """Return full weight vectors (n, 3^d) for q (n, d)."""
        left, right = self.halves(q)
        return (left[:, :, None] * right[:, None, :]).reshape(len(q), -1)

    def _kronecker(self, weights: FloatArray, begin: int, end: int) -> FloatArray:
        """Return the Kronecker product for a batch, joint by joint from the last.

        Needs less memory than gathering all factors. Built transposed, for long inner loops over the rows, and returned
        as a transposed view.
        """
        count = len(weights)
        factors = np.ascontiguousarray(weights[:, begin:end].transpose(1, 2, 0))
        product = np.ones((1, count))
        for factor, size in zip(factors[::-1], self.sizes[begin:end][::-1], strict=True):
            product = (factor[:size, None] * product).reshape(len(product) * size, count)
        return product.T


def _factor_index(sizes: tuple[int, ...], first_joint: int) -> IntArray:
    """Return the indices (joints, entries) of the joint weights that multiply to each product entry.

    They count the flat joint weights, 3 per joint. For a single vector, gathering and reducing costs a third of a chain
    of outer products.
    """
    digits = (
        np.array(np.unravel_index(np.arange(math.prod(sizes)), sizes), dtype=np.intp) if sizes else np.empty((0, 1))
    )
    joints = first_joint + np.arange(len(sizes))
    return np.ascontiguousarray(digits + 3 * joints[:, None], dtype=np.intp)
