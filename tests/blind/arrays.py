"""Arrays and vectors as the hider writes them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Vector = tuple[float, float, float]


def vector(values: Iterable[float]) -> Vector:
    """Return three floats as a tuple."""
    x, y, z = (float(value) for value in values)
    return x, y, z
