"""Handle effects that begin at a moment, or grow from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .effect_type import Effect
from .motion import Motion


def drift_share(motion: Motion, time_constant_s: float) -> FloatArray:
    """Return the fraction of a drift that has developed (n,), from 0 at the start of the motion towards 1."""
    return -np.expm1(-(motion.clock - motion.began) / time_constant_s)


def after(motion: Motion, effect: Effect) -> NDArray[np.bool_]:
    """Return True for rows (n,) after the moment at which an effect begins."""
    return motion.clock >= effect.values[-1]


def since(motion: Motion, effect: Effect) -> FloatArray:
    """Return 1 for rows (n, 1, 1) after the moment at which an effect begins, otherwise 0."""
    return after(motion, effect)[:, None, None].astype(np.float64)


def with_moment(columns: FloatArray) -> FloatArray:
    """Return derivatives (n, 3, p) with zeros appended for the moment, or for another shape that comes last."""
    return np.concatenate([columns, np.zeros_like(columns[:, :, :1])], axis=2)
