"""Compare two recordings of the same joint angles: distances between their positions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from kbmaps.chains.align import rigid_motion


class _Settings:
    # Rows whose joints differ by more are not at the same joint angles [rad, m].
    same_angles = 1e-6
    worst_rows = 5
    min_aligned = 4  # a rigid alignment of fewer points leaves no residual


class Distances(msgspec.Struct, frozen=True):
    """Distances between the positions of two recordings."""

    mean_mm: float
    rms_mm: float
    median_mm: float
    max_mm: float

    @classmethod
    def of(cls, differences: FloatArray) -> Distances:
        """Return the figures of differences (n, 3) [m]."""
        distance = 1e3 * np.linalg.norm(differences, axis=1)
        rms = math.sqrt(float(np.mean(distance**2)))
        return cls(float(distance.mean()), rms, float(np.median(distance)), float(distance.max()))


class Aligned(msgspec.Struct, frozen=True):
    """Distances after the second recording is rigidly aligned with the first."""

    distances: Distances  # distances after alignment
    # shift_mm, turn_deg: translation at its centroid, and rotation
    shift_mm: tuple[float, float, float]
    turn_deg: float


class WorstRow(msgspec.Struct, frozen=True):
    """A row with the largest distance: row numbers, from 1, and the second minus the first position."""

    row: int
    other_row: int
    distance_mm: float
    apart_mm: tuple[float, float, float]
    q: tuple[float, ...]


class LeftOut(msgspec.Struct, frozen=True):
    # first, second: number of rows of each recording without a match in the other
    first: int
    second: int
    first_row: int | None  # number of the first such row of the first recording, or None
    second_row: int | None  # the same for the second
    # joint, by: the joint that differs most between the first unmatched row and the row of the same number in the
    # other recording, and by how much [rad, m]
    joint: str | None
    by: float | None


class ComparisonReport(msgspec.Struct, frozen=True, kw_only=True):
    """Distances between the positions of two recordings; differences are the second minus the first."""

    first: str
    second: str
    joints: tuple[str, ...]
    # rows, other_rows: number of rows of each recording
    rows: int
    other_rows: int
    compared: int  # number of rows at the same joint angles in both
    left_out: LeftOut
    distances: Distances
    # axis_mean_mm, axis_rms_mm: per coordinate
    axis_mean_mm: tuple[float, float, float]
    axis_rms_mm: tuple[float, float, float]
    aligned: Aligned | None  # None with too few rows
    worst: tuple[WorstRow, ...]


@dataclass(frozen=True)
class _Match:
    """Indices of matching rows, (m,) each."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]


def compared(first: Recording, second: Recording, names: tuple[str, str]) -> ComparisonReport:
    """Return the comparison of two recordings, named `names`.

    Raises:
        RecordingError: they have different joints, or no row in common.
    """
    if set(first.joints) != set(second.joints):
        only = ", ".join(sorted(set(first.joints) ^ set(second.joints)))
        raise RecordingError(
            f"is of other joints than {names[0]}: only one of them has {only}",
            file=names[1],
            remedy="Compare recordings of one robot",
        )
    columns = [second.joints.index(joint) for joint in first.joints]
    other_q = second.q[:, columns]
    match = _matched(first.q, other_q)
    left_out = _left_out(first, other_q, match)
    if not len(match.first):
        raise RecordingError(
            f"has no row at the joint angles of one in {names[0]}{_largest_difference(left_out)}",
            file=names[1],
            remedy=f"`bodyschema simulate --like {names[0]}` gives one that has",
        )
    x, other = first.x[match.first], second.x[match.second]
    differences = other - x
    return ComparisonReport(
        first=names[0],
        second=names[1],
        joints=first.joints,
        rows=len(first),
        other_rows=len(second),
        compared=len(differences),
        left_out=left_out,
        distances=Distances.of(differences),
        axis_mean_mm=_as_tuple(1e3 * differences.mean(axis=0)),
        axis_rms_mm=_as_tuple(1e3 * np.sqrt((differences**2).mean(axis=0))),
        aligned=_aligned(x, other),
        worst=_worst(first, match, differences),
    )


def _matched(q: FloatArray, other: FloatArray) -> _Match:
    """Match row by row if the row counts agree; otherwise each row with the nearest unmatched one of the other."""
    if len(q) == len(other):
        rows = np.flatnonzero(np.abs(q - other).max(axis=1) <= _Settings.same_angles)
        return _Match(rows, rows)
    near = KDTree(other).query_ball_point(q, _Settings.same_angles, p=np.inf, return_sorted=True)
    free = np.ones(len(other), dtype=bool)
    pairs = []
    for row, candidates in enumerate(near):
        found = next((k for k in candidates if free[k]), None)
        if found is not None:
            free[found] = False
            pairs.append((row, found))
    indices = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return _Match(indices[:, 0], indices[:, 1])


def _left_out(first: Recording, other_q: FloatArray, match: _Match) -> LeftOut:
    rows = np.setdiff1d(np.arange(len(first)), match.first)
    other_rows = np.setdiff1d(np.arange(len(other_q)), match.second)
    joint = by = None
    if len(rows) and rows[0] < len(other_q):
        differences = np.abs(first.q[rows[0]] - other_q[rows[0]])
        joint, by = first.joints[int(differences.argmax())], float(differences.max())
    return LeftOut(len(rows), len(other_rows), _number(rows), _number(other_rows), joint, by)


def _number(rows: NDArray[np.int64]) -> int | None:
    return int(rows[0]) + 1 if len(rows) else None


def _largest_difference(left_out: LeftOut) -> str:
    return "" if left_out.joint is None else f"; in the first, {left_out.joint} differs by {left_out.by:.4g}"


def _aligned(x: FloatArray, other: FloatArray) -> Aligned | None:
    if len(x) < _Settings.min_aligned:
        return None
    moved, turn = aligned_to(x, other)
    angle = float(np.degrees(Rotation.from_matrix(turn).magnitude()))
    return Aligned(Distances.of(moved - x), _as_tuple(1e3 * (x.mean(axis=0) - other.mean(axis=0))), angle)


def aligned_to(x: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the positions `other` (n, 3) rigidly aligned with `x` (n, 3), and the rotation (3, 3)."""
    turn, shift = rigid_motion(other, x, np.ones(len(x)))
    return other @ turn.T + shift, turn


def _worst(first: Recording, match: _Match, differences: FloatArray) -> tuple[WorstRow, ...]:
    distance = np.linalg.norm(differences, axis=1)
    return tuple(
        WorstRow(
            int(match.first[k]) + 1,
            int(match.second[k]) + 1,
            1e3 * float(distance[k]),
            _as_tuple(1e3 * differences[k]),
            tuple(first.q[match.first[k]].tolist()),
        )
        for k in np.argsort(-distance, kind="stable")[: _Settings.worst_rows]
    )


def _as_tuple(values: FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
