"""Normalised least-mean-squares learner, which updates the map with each pair."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, IntArray, matching_rows, rows_or_vector, vector
from kbmaps.errors import ModelFormatError, SettingError, ShapeError
from kbmaps.maps.basis import describe_bases, parse_bases
from kbmaps.maps.code_path import net_kernel
from kbmaps.maps.kbmap import POSITION_OUTPUTS, KBMap, pose_targets
from kbmaps.maps.stack import BasisStack
from kbmaps.packed import complete, count, named, number, or_infinite, pack, restoring, unless_infinite, unpack


@dataclass(frozen=True)
class StepSize:
    """Step size μ(t) = max(floor, mu0 / (1 + t / decay)) after t pairs: constant unless a decay is given.

    Any μ between 0 and 2 is stable. A constant one leaves noise of about 1.6 σ √(μ / (2 − μ)) in the map. A decaying
    one averages the noise down to the level of the floor, and the floor keeps the map able to follow changes.

    Attributes:
        mu0: share of the first error that is corrected.
        decay: number of pairs after which μ is half of mu0; infinity for never.
        floor: lower bound of μ.

    Raises:
        SettingError: mu0 is not between 0 and 2, decay not above 0, or floor not within 0..mu0.
    """

    mu0: float = 0.5
    decay: float = math.inf
    floor: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.mu0 < 2.0:
            raise SettingError(f"mu0 must lie between 0 and 2 for the rule to be stable, got {self.mu0!r}")
        if not self.decay > 0.0:
            raise SettingError(f"decay must be greater than 0 pairs (infinity for a constant step), got {self.decay!r}")
        if not 0.0 <= self.floor <= self.mu0:
            raise SettingError(f"floor must lie between 0 and mu0 = {self.mu0!r}, got {self.floor!r}")
        for name in ("mu0", "decay", "floor"):
            object.__setattr__(self, name, float(getattr(self, name)))

    def at(self, pairs: int) -> float:
        """Return μ after this many pairs."""
        return max(self.floor, self.mu0 / (1.0 + pairs / self.decay))

    def run(self, pairs: int, steps: int) -> FloatArray:
        """Return μ (steps,) of the next steps after this many pairs."""
        return np.maximum(self.floor, self.mu0 / (1.0 + np.arange(pairs, pairs + steps) / self.decay))


_KIND = "nlms, 1"


class NLMS:
    """Learner that moves the control points by the smallest step that corrects the share mu0 of each pair's error.

    Learns the outputs of its initial map, position or position and orientation, in that map's bases; scaled orthonormal
    ones (`learning_bases`) are advised.

    Args:
        kbmap: the map to start from.
        mu0: the share, constant or as a `StepSize` of the pairs learnt so far.

    Raises:
        SettingError: mu0 is not between 0 and 2.

    Example:
        >>> import numpy as np
        >>> from kbmaps import NLMS, RigidChain, learning_bases
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> learner = NLMS(arm.to_kbmap(learning_bases([-1, -1], [1, 1])), mu0=1.0)
        >>> learner.learn([0.1, 0.2], [0.5, 0.0, 0.0])
        >>> learner.map.predict([0.1, 0.2]).round(9) + 0.0  # a full step: the pair is met
        array([0.5, 0. , 0. ])
    """

    def __init__(self, kbmap: KBMap, mu0: float | StepSize = StepSize.mu0) -> None:
        self._bases = kbmap.bases
        self._step_size = mu0 if isinstance(mu0, StepSize) else StepSize(mu0)
        self._pairs = 0
        self._stack = BasisStack(kbmap.bases)
        self._outputs = len(kbmap.net)
        self._planes = np.array(kbmap.net.reshape(-1, self._stack.right_size))
        check_q = partial(vector, "q", width=self._stack.joints)
        check_x = partial(vector, "x", width=self._outputs)
        self._kernel = net_kernel(self._stack, self._planes, check_q, check_x)
        check_rows = partial(rows_or_vector, "q", width=self._stack.joints)
        self._reader = net_kernel(self._stack, self._planes, check_rows, check_x)

    @property
    def step_size(self) -> StepSize:
        return self._step_size

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return self._stack.joints

    @property
    def pairs(self) -> int:
        """Number of steps so far, replayed ones included."""
        return self._pairs

    @property
    def map(self) -> KBMap:
        """Snapshot of the learnt map; later learning does not change it."""
        sizes = [basis.size for basis in self._bases]
        return KBMap(self._bases, self._planes.reshape(self._outputs, *sizes))

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return the marker position (3,) [m] at joint angles q (d,) [rad], or (n, 3) at (n, d).

        Equal to `map.predict`, without a copy of the map.
        """
        return self._reader.outputs(q, 0, POSITION_OUTPUTS)

    def learn(self, q: ArrayLike, x: ArrayLike, rotation: ArrayLike | None = None) -> None:
        """Take one step for marker position x (3,) [m] at joint angles q (d,) [rad].

        Args:
            q: joint angles (d,) [rad].
            x: marker position (3,) [m].
            rotation: the orientation, (3, 3) or a quaternion x, y, z, w (4,); for a map with orientation only.

        Raises:
            SettingError: a rotation missing or not expected. Nothing has changed.
        """
        mu = self._step_size.at(self._pairs)
        if rotation is None and self._outputs == POSITION_OUTPUTS:
            self._kernel.step(q, x, mu)
        else:
            angles, position = vector("q", q, self._stack.joints), vector("x", x, POSITION_OUTPUTS)
            self._kernel.step(angles, pose_targets(position[None], rotation, self._outputs)[0], mu)
        self._pairs += 1

    def replay(
        self, q: ArrayLike, x: ArrayLike, order: ArrayLike | None = None, rotation: ArrayLike | None = None
    ) -> None:
        """Take steps for the pairs q (n, d) [rad], x (n, 3) [m] in the sequence `order` (indices), or as they are.

        Equal to `learn` on each of them up to rounding, at a fraction of its cost.

        Args:
            q: joint angles (n, d) [rad].
            x: marker positions (n, 3) [m].
            order: indices of the pairs; None: each once, in order.
            rotation: the orientations, (n, 3, 3) or quaternions (n, 4), as for `learn`.

        Raises:
            SettingError: an index outside the pairs, rotations missing or not expected. Nothing has changed.
        """
        angles, positions = matching_rows(q, x, self._stack.joints)
        targets = pose_targets(positions, rotation, self._outputs)
        sequence = np.arange(len(angles)) if order is None else _checked_order(order, len(angles))
        steps = self._step_size.run(self._pairs, len(sequence))
        self._kernel.replay(np.ascontiguousarray(angles), np.ascontiguousarray(targets), sequence, steps)
        self._pairs += len(sequence)

    def to_bytes(self) -> bytes:
        """Return the learner's state; a learner restored by `from_bytes` continues identically to the last bit."""
        settings = self._step_size
        fields: dict[str, Any] = {
            "bases": describe_bases(self._bases),
            "mu0": settings.mu0,
            "decay": unless_infinite(settings.decay),
            "floor": settings.floor,
            "pairs": self._pairs,
        }
        return pack(_KIND, fields, {"planes": self._planes})

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Return the learner in `data`."""
        fields, arrays = unpack(data, _KIND)
        with restoring("an NLMS learner"):
            named(fields, "the fields", ("bases", "mu0", "decay", "floor", "pairs"))
            complete(arrays, ("planes",))
            bases = parse_bases(fields["bases"])
            steps = StepSize(
                number(fields["mu0"], "mu0"), or_infinite(fields["decay"], "decay"), number(fields["floor"], "floor")
            )
            learner = cls(KBMap(bases, arrays["planes"].reshape(-1, *(basis.size for basis in bases))), steps)
            if arrays["planes"].shape != learner._planes.shape:
                raise ModelFormatError("the net is not laid out as its bases are")
            learner._pairs = count(fields["pairs"], "the number of pairs")
        return learner


def _checked_order(order: ArrayLike, pairs: int) -> IntArray:
    sequence = np.asarray(order)
    if sequence.ndim != 1 or not np.issubdtype(sequence.dtype, np.integer):
        raise ShapeError("order", "(k,) integers", sequence.shape)
    if len(sequence) and (int(sequence.min()) < 0 or int(sequence.max()) >= pairs):
        raise SettingError(f"order holds indices outside 0..{pairs - 1}")
    return sequence.astype(np.intp)
