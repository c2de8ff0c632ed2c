"""Normalised least-mean-squares: the instant learner."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kbmaps import lapack
from kbmaps.arrays import FloatArray, IntArray, rows, vector
from kbmaps.errors import SettingError, ShapeError
from kbmaps.kbmap import POSITION_OUTPUTS, KBMap
from kbmaps.stack import BasisStack

DEFAULT_MU0 = 0.5
_BLOCK = 64


class NLMS:
    """Moves the control points a step towards each new pair, the least that mends the share mu0 of its error.

    Learns the position in the bases of the map it starts from; scaled orthonormal ones (`learning_bases`) are advised.
    Any 0 < mu0 < 2 is stable; the noise left in the map is about 1.6 σ √(mu0 / (2 − mu0)).

    Raises:
        SettingError: mu0 is not between 0 and 2.
        ShapeError: the map also holds an orientation.
    """

    def __init__(self, kbmap: KBMap, mu0: float = DEFAULT_MU0) -> None:
        if not 0.0 < mu0 < 2.0:
            raise SettingError(f"mu0 must lie between 0 and 2 for the rule to be stable, got {mu0!r}")
        if kbmap.has_orientation:
            raise ShapeError("net", f"({POSITION_OUTPUTS}, ...): this learner learns positions", kbmap.net.shape)
        self._bases = kbmap.bases
        self._mu0 = float(mu0)
        self._stack = BasisStack(kbmap.bases)
        # One row for each output and left weight, one column for each right weight.
        self._planes = np.array(kbmap.net.reshape(-1, self._stack.right_size))

    @property
    def mu0(self) -> float:
        return self._mu0

    @property
    def map(self) -> KBMap:
        """What has been learnt so far: a snapshot that later learning does not touch."""
        sizes = [basis.size for basis in self._bases]
        return KBMap(self._bases, self._planes.reshape(POSITION_OUTPUTS, *sizes))

    def learn(self, q: ArrayLike, x: ArrayLike) -> None:
        """One step for marker position x (3,) [m] at joint angles q (d,) [rad].

        Raises:
            ShapeError, NonFiniteError: nothing has changed.
        """
        angles = vector("q", q, self._stack.joints)
        position = vector("x", x, POSITION_OUTPUTS)
        left, right = self._stack.halves(angles)
        predicted = (self._planes @ right).reshape(POSITION_OUTPUTS, -1) @ left
        # ‖w‖² of a Kronecker product is the product of its factors' norms.
        mu = self._mu0 / float((left @ left) * (right @ right))
        # Ulbrich et al. 2009, eq. (20)
        error = mu * (position - predicted)
        lapack.add_outer_in_place(self._planes, (error[:, None] * left).ravel(), right)

    def replay(self, q: ArrayLike, x: ArrayLike, order: ArrayLike | None = None) -> None:
        """Steps for the pairs q (n, d) [rad], x (n, 3) [m] in the sequence `order` (indices), else as they stand.

        Equal to `learn` on each of them up to rounding, at a fraction of its cost.

        Raises:
            ShapeError, NonFiniteError, SettingError (an index outside the pairs): nothing has changed.
        """
        angles = rows("q", q, self._stack.joints)
        positions = rows("x", x, POSITION_OUTPUTS)
        if len(angles) != len(positions):
            raise ShapeError("x", f"({len(angles)}, 3) to go with q", positions.shape)
        sequence = np.arange(len(angles)) if order is None else _checked_order(order, len(angles))
        for start in range(0, len(sequence), _BLOCK):
            block = sequence[start : start + _BLOCK]
            self._learn_block(angles[block], positions[block])

    def _learn_block(self, q: FloatArray, x: FloatArray) -> None:
        """A block of consecutive steps as one triangular solve.

        Step j sees the errors left by the steps i < j: e_j = x_j − f(q_j) − Σ_{i<j} mu0 k_ij / k_ii e_i with
        k_ij = w_i · w_j, a product over the joints.
        """
        left, right = self._stack.halves(q)
        kernel = (left @ left.T) * (right @ right.T)
        steps = self._mu0 / np.diag(kernel)
        by_left = (right @ self._planes.T).reshape(len(q), POSITION_OUTPUTS, -1)
        errors = x - (by_left @ left[:, :, None])[:, :, 0]
        np.einsum("ij,j->ij", kernel, steps, out=kernel)
        for j in range(1, len(q)):
            errors[j] -= kernel[j, :j] @ errors[:j]
        moves = (errors * steps[:, None])[:, :, None] * left[:, None, :]
        self._planes += moves.reshape(len(q), -1).T @ right


def _checked_order(order: ArrayLike, pairs: int) -> IntArray:
    sequence = np.asarray(order)
    if sequence.ndim != 1 or not np.issubdtype(sequence.dtype, np.integer):
        raise ShapeError("order", "(k,) integers", sequence.shape)
    if len(sequence) and (int(sequence.min()) < 0 or int(sequence.max()) >= pairs):
        raise SettingError(f"order holds indices outside 0..{pairs - 1}")
    return sequence.astype(np.intp)
