"""Derivatives of maps that are in {1, cos θ, sin θ} of every joint, from two values per joint."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, rows_or_vector
from kbmaps.chains.carried import Predictor
from kbmaps.maps.basis import JointBasis

# Large enough that rounding costs only two digits, small enough for a map that is not exactly of this form.
_STEP = 1e-2


def slopes(model: Predictor, q: ArrayLike, bases: Sequence[JointBasis]) -> FloatArray:
    """Return the derivative (3, d) [m/rad, or m/m] of a model's positions at q (d,), or (n, 3, d) at q (n, d).

    f(θ + h) − f(θ − h) = 2 sin h f'(θ) for any f = a + b cos θ + c sin θ and any h. So this is exact for KB-Maps in any
    form; likewise with 2 h for a prismatic joint.

    Raises:
        ShapeError, NonFiniteError
    """
    angles = rows_or_vector("q", q, len(bases))
    steps = _STEP * np.eye(len(bases))
    flat = angles.reshape(-1, 1, len(bases))
    ahead, behind = (model.predict((flat + way * steps).reshape(-1, len(bases))) for way in (1.0, -1.0))
    lengths = np.array([2.0 * (_STEP if basis.is_prismatic else math.sin(_STEP)) for basis in bases])
    columns = (ahead - behind).reshape(len(flat), len(bases), 3) / lengths[:, None]
    return columns.swapaxes(1, 2).reshape(*angles.shape[:-1], 3, len(bases))
