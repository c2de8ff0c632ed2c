"""Evaluation and update of a control net at joint angles: the NumPy path."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from kbmaps import lapack
from kbmaps.arrays import FloatArray, IntArray, batches
from kbmaps.maps.stack import BasisStack

Check = Callable[[ArrayLike], FloatArray]
"""Turns what a caller gave into a finite array of the right shape, or raises."""

_BLOCK = 64


class NumpyNet:
    """Evaluator of a net, half by half: the weights of 3^d control points are never formed.

    Args:
        stack: stack of the bases.
        planes: the net (outputs · left_size, right_size): one row for each output and left weight, one column for each
            right weight. Shared, not copied; `step` and `replay` write to it.
        check_q: check of joint angles, a vector (d,) or also rows (n, d).
        check_x: check of a vector of targets (outputs,).
    """

    def __init__(self, stack: BasisStack, planes: FloatArray, check_q: Check, check_x: Check) -> None:
        self._stack = stack
        self._planes = planes
        self._outputs = len(planes) // stack.left_size
        self._check_q, self._check_x = check_q, check_x

    def outputs(self, q: ArrayLike, begin: int, end: int) -> FloatArray:
        """Return outputs begin..end at q: (end − begin,) or (n, end − begin)."""
        angles, stack, count = self._check_q(q), self._stack, end - begin
        planes = self._planes[begin * stack.left_size : end * stack.left_size]
        if angles.ndim == 1:
            left, right = stack.halves(angles)
            return planes.dot(right).reshape(count, -1).dot(left)
        out = np.empty((len(angles), count))
        for rows in batches(len(angles)):
            left, right = stack.halves(angles[rows])
            out[rows] = contracted(planes, left, right)
        return out

    def derivatives(self, q: ArrayLike, begin: int, end: int) -> FloatArray:
        """Return derivatives of outputs begin..end by the joints: (end − begin, d) or (n, end − begin, d)."""
        angles = self._check_q(q)
        if angles.ndim == 1:
            return self._derivatives_of_few(angles, begin, end)
        out = np.empty((len(angles), end - begin, self._stack.joints))
        for rows in batches(len(angles)):
            out[rows] = self._derivatives_of_few(angles[rows], begin, end)
        return out

    def step(self, q: ArrayLike, x: ArrayLike, mu0: float) -> None:
        """Take one step of normalised least mean squares towards the targets x (outputs,) at q (d,)."""
        angles, target = self._check_q(q), self._check_x(x)
        left, right = self._stack.halves(angles)
        predicted = self._planes.dot(right).reshape(self._outputs, -1).dot(left)
        # ‖w‖² of a Kronecker product is the product of its factors' norms.
        mu = mu0 / float((left @ left) * (right @ right))
        # Ulbrich et al. 2009, eq. (20)
        error = mu * (target - predicted)
        lapack.add_outer_in_place(self._planes, (error[:, None] * left).ravel(), right)

    def replay(self, q: FloatArray, x: FloatArray, order: IntArray, mu0: FloatArray) -> None:
        """Take a step of mu0 (k,) for each index in `order` (k,) of the pairs q (n, d), x (n, outputs).

        Inputs are not checked.
        """
        for start in range(0, len(order), _BLOCK):
            part = slice(start, start + _BLOCK)
            self._replay_block(q[order[part]], x[order[part]], mu0[part])

    def _replay_block(self, q: FloatArray, targets: FloatArray, mu0: FloatArray) -> None:
        """Take a block of consecutive steps as one triangular solve.

        Step j sees the errors left by the steps i < j: e_j = x_j − f(q_j) − Σ_{i<j} μ_i k_ij / k_ii e_i with
        k_ij = w_i · w_j, a product over the joints.
        """
        left, right = self._stack.halves(q)
        kernel = (left @ left.T) * (right @ right.T)
        steps = mu0 / np.diag(kernel)
        errors = targets - contracted(self._planes, left, right)
        np.einsum("ij,j->ij", kernel, steps, out=kernel)
        for j in range(1, len(q)):
            errors[j] -= kernel[j, :j] @ errors[:j]
        moves = (errors * steps[:, None])[:, :, None] * left[:, None, :]
        self._planes += moves.reshape(len(q), -1).T @ right

    def _derivatives_of_few(self, q: FloatArray, begin: int, end: int) -> FloatArray:
        stack, lead, count = self._stack, q.shape[:-1], end - begin
        weights, slopes = stack.joint_weights(q), stack.joint_derivatives(q)
        planes = self._planes[begin * stack.left_size : end * stack.left_size]
        cube = planes.reshape(count, stack.left_size, stack.right_size)
        by_left = (stack.right(weights) @ planes.T).reshape(*lead, count, stack.left_size)
        by_right = stack.left(weights) @ cube.swapaxes(0, 1).reshape(stack.left_size, -1)
        by_right = by_right.reshape(*lead, count, stack.right_size)
        columns = np.empty((*lead, count, stack.joints))
        for k in range(stack.joints):
            varied = weights.copy()
            varied[..., k, :] = slopes[..., k, :]
            if k < stack.split:
                columns[..., k] = (by_left @ stack.left(varied)[..., None])[..., 0]
            else:
                columns[..., k] = (by_right @ stack.right(varied)[..., None])[..., 0]
        return columns


def contracted(planes: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Return outputs (n, outputs) of many rows.

    Args:
        planes: the net (outputs · left_size, right_size).
        left, right: halves (n, ·) of the rows' weights.
    """
    rows, width = left.shape
    by_left = (planes @ right.T).reshape(len(planes) // width, width, rows)
    return np.einsum("oln,nl->no", by_left, left)
