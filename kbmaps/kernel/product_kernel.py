"""Kernel of KB-Maps: inner products of weight vectors that are never formed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.stack import BasisStack


class ProductKernel:
    """Kernel k(q, q') = w(q) · w(q') = Π_k w_k(q_k) · w_k(q'_k), with the 3^d weights w never formed.

    The inner product of two Kronecker products is the product of their factors' inner products. An entry costs 3 d
    multiplications, for any number of joints d. Inputs are not checked: callers validate them.
    """

    def __init__(self, bases: Sequence[JointBasis]) -> None:
        self.bases = tuple(bases)
        self.joints = len(self.bases)
        self._stack = BasisStack(self.bases)

    def joint_weights(self, q: FloatArray) -> FloatArray:
        """Return the weights of every joint (n, d, 3) at configurations q (n, d), the input of the kernel."""
        return self._stack.joint_weights(q)

    def between(self, weights: FloatArray, others: FloatArray) -> FloatArray:
        """Return the kernel (n, m) between configurations given by their joint weights (n, d, 3) and (m, d, 3)."""
        kernel = weights[:, 0] @ others[:, 0].T
        factor = np.empty_like(kernel)
        for k in range(1, self.joints):
            np.matmul(weights[:, k], others[:, k].T, out=factor)
            kernel *= factor
        return kernel

    def diagonal(self, weights: FloatArray) -> FloatArray:
        """Return k(q, q) (n,) of configurations given by their joint weights (n, d, 3)."""
        return np.square(weights).sum(axis=2).prod(axis=1)
