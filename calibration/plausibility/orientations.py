"""Order of the numbers in which orientations are given."""

from __future__ import annotations

import math

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps import RigidChain, rotation_matrices

# Orders of a quaternion in the columns qx, qy, qz, qw.
AS_IT_IS = ""
_W_FIRST = "hold a quaternion with w first"
_CONJUGATE = "hold the conjugate of the marker's orientation, that of the measurement frame in the marker"
_REORDER = "name the columns qw, qx, qy, qz"
_NEGATE = "multiply qx, qy and qz by -1"
REMEDIES = {
    _W_FIRST: _REORDER,
    _CONJUGATE: _NEGATE,
    f"{_W_FIRST}, and {_CONJUGATE}": f"{_REORDER}, and {_NEGATE}",
}


def errors_rad(chain: RigidChain, q: FloatArray, rotation: FloatArray, turns: FloatArray) -> dict[str, float]:
    """Return the median angle [rad] between the arm's hand and quaternions (n, 4), for each way to read them.

    Args:
        chain: the nominal chain.
        q: joint values (n, d) [rad, m], offsets included.
        rotation: of the nominal measurement frame in the real one (3, 3).
        turns: the columns qx, qy, qz, qw.
    """
    plain, first, conjugate = turns, np.roll(turns, -1, axis=1), np.array([-1.0, -1.0, -1.0, 1.0])
    readings = zip((AS_IT_IS, *REMEDIES), (plain, first, plain * conjugate, first * conjugate), strict=True)
    hand = rotation @ chain.orientation(q)
    return {name: _scatter(hand.swapaxes(1, 2) @ rotation_matrices("orientation", read)) for name, read in readings}


def _scatter(turns: FloatArray) -> float:
    """Return the median angle [rad] of rotations (n, 3, 3) from the one among them that is nearest to the others."""
    cosines = (np.einsum("aij,bij->ab", turns, turns) - 1.0) / 2.0
    return math.acos(float(np.clip(np.median(cosines, axis=1).max(), -1.0, 1.0)))
