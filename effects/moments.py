"""What begins at a moment, and what grows from one on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .effect import Effect
from .motion import Motion


def settled(motion: Motion, time_constant_s: float) -> FloatArray:
    """How much of a drift has come (n,), from 0 when the motion began towards 1."""
    return -np.expm1(-(motion.clock - motion.began) / time_constant_s)


def after(motion: Motion, effect: Effect) -> NDArray[np.bool_]:
    """Which rows (n,) come after the moment at which an effect begins."""
    return motion.clock >= effect.values[-1]
