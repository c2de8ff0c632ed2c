"""Where a fit starts from when the place of the arm is anyone's guess."""

from __future__ import annotations

import math

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.chains.align import align
from kbmaps.chains.parameters import ChainParameters, ChainTolerances
from kbmaps.errors import DegenerateDataError
from kbmaps.rotations import rotation_vector

# So many pairs, evenly spread, show where an arm stands.
_PLACED = 64


class PlacedStart:
    """The nominal chain, placed where it fits best; looked for only when the pairs have doubled.

    The place follows from the first 2^k pairs, so that it does not depend on when it was asked for.
    """

    def __init__(self, parameters: ChainParameters, tolerances: ChainTolerances) -> None:
        self._parameters, self._marker_known = parameters, math.isfinite(tolerances.tool)
        known = math.isfinite(tolerances.base_rotation) and math.isfinite(tolerances.base_translation)
        self.needed = not known
        self._change: FloatArray = np.zeros(parameters.size)
        self._placed_at = 0

    def change(self, q: FloatArray, x: FloatArray) -> FloatArray:
        """The change (size,) to start a fit to at least one pair from; 0 while they do not show a place."""
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
