"""Normalised least-mean-squares: the instant learner."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import IntArray, rows, vector
from kbmaps.errors import SettingError, ShapeError
from kbmaps.kbmap import POSITION_OUTPUTS, KBMap
from kbmaps.kernels import net_kernel
from kbmaps.stack import BasisStack
from kbmaps.targets import pose_targets

DEFAULT_MU0 = 0.5


class NLMS:
    """Moves the control points a step towards each new pair, the least that mends the share mu0 of its error.

    Learns what the map it starts from has, the position or position and orientation, in that map's bases; scaled
    orthonormal ones (`learning_bases`) are advised.
    Any 0 < mu0 < 2 is stable; the noise left in the map is about 1.6 σ √(mu0 / (2 − mu0)).

    Raises:
        SettingError: mu0 is not between 0 and 2.
    """

    def __init__(self, kbmap: KBMap, mu0: float = DEFAULT_MU0) -> None:
        if not 0.0 < mu0 < 2.0:
            raise SettingError(f"mu0 must lie between 0 and 2 for the rule to be stable, got {mu0!r}")
        self._bases = kbmap.bases
        self._mu0 = float(mu0)
        self._stack = BasisStack(kbmap.bases)
        self._outputs = len(kbmap.net)
        self._planes = np.array(kbmap.net.reshape(-1, self._stack.right_size))
        check_q = partial(vector, "q", width=self._stack.joints)
        check_x = partial(vector, "x", width=self._outputs)
        self._kernel = net_kernel(self._stack, self._planes, check_q, check_x)

    @property
    def mu0(self) -> float:
        return self._mu0

    @property
    def map(self) -> KBMap:
        """What has been learnt so far: a snapshot that later learning does not touch."""
        sizes = [basis.size for basis in self._bases]
        return KBMap(self._bases, self._planes.reshape(self._outputs, *sizes))

    def learn(self, q: ArrayLike, x: ArrayLike, rotation: ArrayLike | None = None) -> None:
        """One step for marker position x (3,) [m] at joint angles q (d,) [rad].

        Args:
            rotation: the orientation, (3, 3) or a quaternion x, y, z, w (4,); for a map with orientation only.

        Raises:
            ShapeError, NonFiniteError, RotationError
            SettingError: a rotation too many or too few. Nothing has changed.
        """
        if rotation is None and self._outputs == POSITION_OUTPUTS:
            self._kernel.step(q, x, self._mu0)
            return
        angles, position = vector("q", q, self._stack.joints), vector("x", x, POSITION_OUTPUTS)
        self._kernel.step(angles, pose_targets(position[None], rotation, self._outputs)[0], self._mu0)

    def replay(
        self, q: ArrayLike, x: ArrayLike, order: ArrayLike | None = None, rotation: ArrayLike | None = None
    ) -> None:
        """Steps for the pairs q (n, d) [rad], x (n, 3) [m] in the sequence `order` (indices), else as they stand.

        Equal to `learn` on each of them up to rounding, at a fraction of its cost.

        Args:
            rotation: the orientations, (n, 3, 3) or quaternions (n, 4), as for `learn`.

        Raises:
            ShapeError, NonFiniteError, RotationError
            SettingError: an index outside the pairs, rotations too many or too few. Nothing has changed.
        """
        angles = rows("q", q, self._stack.joints)
        positions = rows("x", x, POSITION_OUTPUTS)
        if len(angles) != len(positions):
            raise ShapeError("x", f"({len(angles)}, 3) to go with q", positions.shape)
        targets = pose_targets(positions, rotation, self._outputs)
        sequence = np.arange(len(angles)) if order is None else _checked_order(order, len(angles))
        self._kernel.replay(np.ascontiguousarray(angles), np.ascontiguousarray(targets), sequence, self._mu0)


def _checked_order(order: ArrayLike, pairs: int) -> IntArray:
    sequence = np.asarray(order)
    if sequence.ndim != 1 or not np.issubdtype(sequence.dtype, np.integer):
        raise ShapeError("order", "(k,) integers", sequence.shape)
    if len(sequence) and (int(sequence.min()) < 0 or int(sequence.max()) >= pairs):
        raise SettingError(f"order holds indices outside 0..{pairs - 1}")
    return sequence.astype(np.intp)
