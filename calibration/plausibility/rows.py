"""Check that angles and positions of a row belong together: logs joined by row number may be shifted by one or two."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .limits import LimitSettings, place_an_arm, spread_m
from .search import ReadingSearch, SearchSettings
from .verdict import FEWEST_ROWS, THRESHOLDS, Plausibility, mm


class _Settings:
    near_rows: int = 3  # a position belongs to the angles of a row this near at most
    # Rows are shifted if this share of them fits so many times better with angles or positions of the row as far
    # away. Up to 0.09 do so in right recordings, 0.16 and more where a fifth of a real recording is shifted.
    shifted: float = 0.12
    shifted_better: float = 5.0
    # Outliers are looked for among few rows: at most so many choices of rows are left out, each a fit of a few ms.
    max_choices: int = 400


def few_outliers(search: ReadingSearch, before: float) -> str:
    """Return a warning if few rows place the arm without some of them, otherwise "".

    Among many rows, outliers do not prevent the others from placing the arm.
    """
    rows, joints = len(search.q), search.chain.joints
    most = rows - math.ceil(LimitSettings.measured_share * rows)
    if math.comb(rows, most) > _Settings.max_choices:
        return ""
    for off in range(1, most + 1):
        if 3 * (rows - off) <= joints + 9:
            break
        left_out = np.array(list(itertools.combinations(range(rows), off)))
        kept = np.array([np.delete(np.arange(rows), some) for some in left_out])
        errors = search.place_rows(kept).errors(1.0)
        best = int(errors.argmin())
        if errors[best] < THRESHOLDS.named / (1 + off) * spread_m(search.x):
            *first, last = (str(row + 1) for row in left_out[best].tolist())
            which = f"{', '.join(first)} and {last}" if first else last
            rows_are = "rows {} are outliers" if off > 1 else "row {} is an outlier"
            return (
                f"perhaps {rows_are.format(which)}: without, the samples fit to {mm(float(errors[best]))}, and as they "
                f"are to {mm(before)}. Measure there again, or leave the rows out"
            )
    return ""


def all_shifted(search: ReadingSearch, q: FloatArray, x: FloatArray, t: FloatArray | None) -> Plausibility | None:
    """Return a refusal if each position belongs to the angles of a row nearby, otherwise None.

    Args:
        search: the search over other readings, which found none.
        q, x, t: all pairs (n, d) [rad, m] and (n, 3) [m], and their times (n,) [s] if known.
    """
    shifts, rows = _rows_nearby(len(q))
    if not place_an_arm(len(rows), search.chain.joints):
        return None
    # Compare the same rows unshifted, since others may contain the outliers.
    tried = [0, *shifts]
    errors = search.errors(np.stack([q[rows + shift] for shift in tried]), np.stack([x[rows]] * len(tried)))
    best = int(errors.argmin())
    before, after, shift = float(errors[0]), float(errors[best]), tried[best]
    if after > THRESHOLDS.named / 2 * spread_m(x) or before < THRESHOLDS.much_better * after:
        return None
    row, remedy = _moved(shift)
    return Plausibility(
        f"it seems that angles and positions are shifted against each other: with the angles of {row}, the samples fit "
        f"to {mm(after)}, and as they are to {mm(before)}",
        _or_late(remedy, shift, t),
        misread=True,
        better=before / after,
    )


def many_apart(search: ReadingSearch, far: float) -> bool:
    """Return True if many rows are far [m] from the arm placed by the others, since a few poses may fit by chance."""
    (apart,) = search.distances(search.q, search.x, [(search.q, search.x)])
    return bool((apart > far).mean() > _Settings.shifted)


def partly_shifted(
    search: ReadingSearch, q: FloatArray, x: FloatArray, t: FloatArray | None, *, fits: bool
) -> Plausibility | None:
    """Return a refusal if in many rows, but not most, angles or positions belong to a row nearby, otherwise None.

    Args:
        search: the search over other readings.
        q, x, t: all pairs (n, d) [rad, m] and (n, 3) [m], and their times (n,) [s] if known.
        fits: True if the pairs place the arm. Otherwise every row may be wrong, and shifted rows also place the arm.
    """
    if len(q) < FEWEST_ROWS:
        return None
    shifts, rows = _rows_nearby(len(q))
    own_q, own_x = q[rows], x[rows]
    of_angles = [(q[rows + shift], own_x) for shift in shifts]
    pairs = [(own_q, own_x), *of_angles, *((own_q, x[rows + shift]) for shift in shifts)]
    place_rows = [(own_q, own_x), *([] if fits else of_angles)]
    found = np.stack([search.distances(*placed, pairs) for placed in place_rows])
    nearer = _Settings.shifted_better * found.min(axis=0)[1:] < found[0, 0]
    shares = nearer.mean(axis=1).reshape(2, -1)
    angles, positions = shares.max(axis=1)
    if max(angles, positions) < _Settings.shifted:
        return None
    shift = shifts[int(shares[0].argmax())]
    row, remedy = _moved(shift)
    fit = f"these fit the angles of {row}"
    remedy = _or_late(f"In these rows: {remedy[0].lower()}{remedy[1:]}", shift, t)
    if positions > THRESHOLDS.much_better * angles:
        fit = f"their angles fit the positions of {_moved(shifts[int(shares[1].argmax())])[0]}"
        remedy = "Join the two logs by time, not by row: rows hold the angles of others"
    return Plausibility(
        "it seems that angles and positions are shifted against each other in "
        f"{100.0 * max(angles, positions):.0f} % of the rows: {fit}",
        remedy,
        misread=True,
    )


def partly_carried(search: ReadingSearch, names: Sequence[str]) -> Plausibility | None:
    """Return a refusal if a joint's column includes the previous joint, which moves in few rows, otherwise None.

    If joints move one after the other, the other rows place the arm, and these rows look like outliers.
    """
    readings, slides = search.carrying(), search.chain.prismatic
    if not readings:
        return None
    angles = [search.q, *(reading.angles(search.q, slides) for reading in readings)]
    own, *read = (search.distances(q, search.x, [(q, search.x)])[0] for q in angles)
    nearer = [_Settings.shifted_better * one < own for one in read]
    shares = [search.poses.mean(rows) for rows in nearer]
    worse = [search.poses.mean(_Settings.shifted_better * own < one) for one in read]
    best = int(np.argmax(np.subtract(shares, worse)))
    gain = search.poses.mean(np.log(np.maximum(own, search.exact_m) / np.maximum(read[best], search.exact_m)))
    if shares[best] - worse[best] < _Settings.shifted or not search.is_certain(gain):
        return None
    nothing = np.zeros(len(names))
    return Plausibility(
        f"it seems that {readings[best].label(names, nothing)}: {100.0 * float(nearer[best].mean()):.0f} % of the rows "
        f"then fit at least {_Settings.shifted_better:g} times better",
        readings[best].remedy(names, nothing),
        misread=True,
    )


def _rows_nearby(count: int) -> tuple[list[int], NDArray[np.intp]]:
    """Return shifts, and the rows of a recording of `count` rows that have neighbours at these distances."""
    near = _Settings.near_rows
    shifts = [shift for shift in range(-near, near + 1) if shift]
    return shifts, np.unique(np.linspace(near, count - 1 - near, SearchSettings.rows).astype(np.intp))


def _moved(shift: int) -> tuple[str, str]:
    """Return a description of the row whose angles fit, and the remedy."""
    count, where = abs(shift), "later" if shift > 0 else "earlier"
    rows = f"{count} row{'s' if count > 1 else ''}"
    return (
        f"{rows} {where}",
        f"Move the columns of the joints by {rows} {'up' if shift > 0 else 'down'}, or the positions the other way; or "
        "join the two logs by time, not by row",
    )


def _or_late(remedy: str, shift: int, t: FloatArray | None) -> str:
    """Return the remedy, preceded by the delay that explains the shift if the rows have times (n,) [s]."""
    if t is None:
        return remedy
    late_ms = -1e3 * shift * float(np.median(np.diff(t)))
    return (
        f"Of a bag or a dataset, add {late_ms:.0f} to --marker-delay-ms; of another recording, "
        f"{remedy[0].lower()}{remedy[1:]}"
    )
