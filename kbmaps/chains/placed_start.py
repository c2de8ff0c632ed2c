"""Starting point of a fit when the pose of the arm is unknown."""

from __future__ import annotations

import math

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.chains.align import align
from kbmaps.chains.parameters import ChainParameters, ChainTolerances
from kbmaps.errors import DegenerateDataError
from kbmaps.rotations import rotation_vector

# This many evenly spread pairs suffice to place the arm.
_PLACED = 64


class PlacedStart:
    """Nominal chain at its best-fitting pose; refitted only when the number of pairs has doubled.

    The pose follows from the first 2^k pairs, so that it does not depend on when it was requested.
    """

    def __init__(self, parameters: ChainParameters, tolerances: ChainTolerances) -> None:
        self._parameters, self._marker_known = parameters, math.isfinite(tolerances.tool)
        known = math.isfinite(tolerances.base_rotation) and math.isfinite(tolerances.base_translation)
        self.needed = not known
        self._change: FloatArray = np.zeros(parameters.size)
        self._placed_at = 0

    def change(self, q: FloatArray, x: FloatArray) -> FloatArray:
        """Return the change (size,) to start a fit from; 0 while the pairs do not determine a pose.

        Args:
            q: joint values of at least one pair (n, d) [rad, m].
            x: marker positions (n, 3) [m].
        """
        first = 1 << (len(q).bit_length() - 1)
        if self.needed and first != self._placed_at:
            chosen = np.linspace(0, first - 1, min(first, _PLACED)).round().astype(np.intp)
            self._change, self._placed_at = self._placed(q[chosen], x[chosen]), first
        return self._change

    def _placed(self, q: FloatArray, x: FloatArray) -> FloatArray:
        parameters, change = self._parameters, np.zeros(self._parameters.size)
        try:
            placed = align(parameters.reference, q, x, pose_known=False, marker_known=self._marker_known)
        except DegenerateDataError:
            return change
        change[parameters.base_turn] = rotation_vector(placed.T_measured_nominal[:3, :3])
        change[parameters.base_shift] = placed.T_measured_nominal[:3, 3]
        change[parameters.tool] = placed.marker_shift
        return change
