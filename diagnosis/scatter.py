"""What the scatter of single readings makes of a joint that seems to remember its way."""

from __future__ import annotations

import numpy as np

from effects import Effect
from interfaces.records import FloatArray

from .fit import Fit

# Where these say that a joint is, is read off its own last readings.
_OF_ITS_WAY = ("backlash", "settling")


def beside_scatter(fit: Fit, effect: Effect, columns: FloatArray) -> FloatArray:
    """Weighted columns (n, 3, k) of an effect, less what looks like the scatter of its joint's single readings.

    A play or a lag takes the joint to be nearer to the reading before, which is right of a reading that is off by
    itself, and a gain that no gear has. Of readings with white errors eᵢ, whatever depends on qᵢ − qᵢ₋₁ has as much in
    common with eᵢ as with −eᵢ₋₁, and nothing with eᵢ once its part along qᵢ₋₁ − 2 qᵢ + qᵢ₊₁ is gone. What follows the
    direction of motion stays.
    """
    if effect.name not in _OF_ITS_WAY or effect.where is None:
        return columns
    motion, joint = fit.observations.motion, fit.simulation.robot.joints.index(effect.where)
    inside = np.flatnonzero(~motion.begins[1:-1] & ~motion.begins[2:]) + 1
    bends = np.zeros(len(motion.q))
    bends[inside] = np.diff(motion.q[:, joint], 2)[inside - 1]
    basis = fit.orthogonal
    scatter = fit.weighted(fit.run.by_joint[:, :, [joint]] * bends[:, None, None])
    scatter, columns = (each - basis @ np.einsum("nir,nik->rk", basis, each) for each in (scatter, columns))
    square = float(np.square(scatter).sum())
    if square <= 0.0:
        return columns
    return columns - scatter * (np.einsum("nir,nik->rk", scatter, columns) / square)
