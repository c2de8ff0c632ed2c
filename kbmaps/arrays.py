"""Array types, and validation of arrays that enter the package."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kbmaps.errors import NonFiniteError, NotNumbersError, SettingError, ShapeError

FloatArray: TypeAlias = NDArray[np.float64]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.intp]


def numbers(name: str, values: ArrayLike) -> FloatArray:
    """Return `values` as a float64 array of any shape."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise NotNumbersError(name, values) from error


def frozen(values: ArrayLike) -> FloatArray:
    """Return a read-only float64 copy in C order."""
    copy = np.array(values, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy


def vector(name: str, values: ArrayLike, width: int) -> FloatArray:
    """Return `values` as a finite float64 vector (width,)."""
    array = numbers(name, values)
    if array.shape != (width,):
        raise ShapeError(name, f"({width},)", array.shape)
    # For so few numbers, summing a list is several times cheaper than np.isfinite.
    if not math.isfinite(sum(array.tolist())):
        raise NonFiniteError(name)
    return array


def rows(name: str, values: ArrayLike, width: int) -> FloatArray:
    """Return `values` as finite float64 rows (n, width)."""
    array = numbers(name, values)
    if array.ndim != 2 or array.shape[1] != width:
        raise ShapeError(name, f"(n, {width})", array.shape)
    if not np.isfinite(array).all():
        raise NonFiniteError(name)
    return array


def matching_rows(q: ArrayLike, x: ArrayLike, joints: int) -> tuple[FloatArray, FloatArray]:
    """Return pairs as finite float64 rows q (n, joints) and x (n, 3)."""
    angles, positions = rows("q", q, joints), rows("x", x, 3)
    if len(angles) != len(positions):
        raise ShapeError("x", f"({len(angles)}, 3) to go with q", positions.shape)
    return angles, positions


def rows_or_vector(name: str, values: ArrayLike, width: int) -> FloatArray:
    """Return `values` as a finite vector (width,) or finite rows (n, width), keeping its dimensions."""
    array = numbers(name, values)
    if array.ndim == 1:
        return vector(name, array, width)
    if array.ndim != 2 or array.shape[1] != width:
        raise ShapeError(name, f"({width},) or (n, {width})", array.shape)
    if not np.isfinite(array).all():
        raise NonFiniteError(name)
    return array


def require_positive(name: str, value: float, unit: str = "") -> None:
    """Raise SettingError unless the value is finite and greater than 0."""
    if not (value > 0.0 and math.isfinite(value)):
        raise SettingError(f"{name} must be finite and greater than 0{unit}, got {value!r}")


def batches(count: int, rows: int = 1024) -> Iterator[slice]:
    """Yield slices of at most `rows` rows, few enough to stay in the cache, that together cover `count` rows."""
    return (slice(start, start + rows) for start in range(0, count, rows))


def limits(name: str, values: ArrayLike, width: int) -> FloatArray:
    """Return `values` as a float64 vector (width,); infinite entries are allowed."""
    array = numbers(name, values)
    if array.shape != (width,):
        raise ShapeError(name, f"({width},)", array.shape)
    if np.isnan(array).any():
        raise NonFiniteError(name)
    return array


def evenly_spread(count: int, most: int) -> NDArray[np.intp]:
    """Return at most `most` of the indices 0 ... count − 1, evenly spread, including the first and the last."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.intp)
