"""Rows of a recording by pose: those of one pose share the errors of the links, and say together what one says."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bodyschema.interfaces.records import FloatArray
from kbmaps import RigidChain

from .limits import A_RADIAN_M

# Rows within this distance, of the joint that moved farthest, are of one pose: along a path the errors of links change
# slowly.
_APART_RAD = math.radians(10.0)


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses that are far from each other, and the rows near each."""

    rows: NDArray[np.intp]  # the row of each pose (k,)
    of_rows: NDArray[np.intp]  # index of the nearest pose for each row (n,)

    @classmethod
    def of(cls, chain: RigidChain, q: FloatArray) -> Poses:
        """Choose poses of rows q (n, d) [rad, m] that are apart in at least one joint."""
        q = q / np.where(chain.prismatic, A_RADIAN_M, 1.0)
        distances = np.abs(q[:, None] - q).max(axis=2)
        kept: list[int] = []
        for row, far in enumerate(distances > _APART_RAD):
            if far[kept].all():
                kept.append(row)
        return cls(np.array(kept, dtype=np.intp), distances[:, kept].argmin(axis=1))

    def mean(self, values: ArrayLike) -> float:
        """Return the mean of values (n,) of the rows, each pose counted once."""
        return float((np.bincount(self.of_rows, values) / np.bincount(self.of_rows)).mean())

    def nats(self, gain: float, joints: int, share: float = 1.0) -> float:
        """Return the evidence for a reading over another one, each placed by these rows [nats].

        Any reading fits as many coordinates as there are offsets of joints, camera and marker.

        Args:
            gain: logarithm of the ratio of their distances.
            share: of the rows, by which the distances are measured.
        """
        return gain * max(3.0 * share * len(self.rows) - joints - 9.0, 0.0)
