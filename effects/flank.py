"""Model a joint with backlash under load: it rests on the flank to which gravity pulls it."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray


def flanks(torque: FloatArray, hold: float, before: float = 0.0) -> FloatArray:
    """Return the flank of its backlash on which a joint rests (n,): 1 or -1, the sign of its torque.

    It changes sides when the opposite torque exceeds `hold`: until then friction in the gear keeps it in place.

    Args:
        torque: gravity's torque about the joint, in the order of the rows [N·m or N], shape (n,).
        hold: friction [N·m or N].
        before: flank before the first row; 0 if unknown, then the sign of the first torque counts.
    """
    sides = np.where(torque < 0.0, -1.0, 1.0)
    decided = np.abs(torque) > hold
    last = np.maximum.accumulate(np.where(decided, np.arange(len(torque)), -1))
    first = before or (float(sides[0]) if len(sides) else 0.0)
    return np.where(last >= 0, sides[np.maximum(last, 0)], first)
