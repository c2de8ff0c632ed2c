"""On which side of its play a joint is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .fit import Fit


def before_contact(fit: Fit) -> NDArray[np.bool_]:
    """Rows (n,) at which nobody knows on which side of its play a joint is: it has not crossed it in this run yet."""
    motion = fit.observations.motion
    rows = np.zeros(len(motion), dtype=np.bool_)
    for effect in fit.simulation.effects:
        if effect.name != "backlash":
            continue
        q = motion.q[:, fit.simulation.place(effect).joint]
        for first, end in motion.runs:
            crossed = np.maximum.accumulate(q[first:end]) - np.minimum.accumulate(q[first:end]) >= effect.values[0]
            rows[first:end] |= ~crossed
    return rows
