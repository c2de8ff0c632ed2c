"""Names, groups and validity checks of a recording's columns.

| columns | meaning |
| --- | --- |
| one per joint, under its URDF name | joint angles [rad] (m for a prismatic joint) |
| x, y, z | marker position in the measurement frame [m] |
| t | time [s], strictly increasing inside a segment |
| segment | number of the run of samples |
| sx, sy, sz | 1-sigma of x, y, z [m]; or instead |
| cxx, cxy, cxz, cyy, cyz, czz | upper triangle of their covariance [m²] |
| ul, vl, ur, vr | pixel centres in the left and the right image [px] |
| qx, qy, qz, qw | orientation of the marker, a unit quaternion |
| current_<joint>, temperature_<joint> | [A], [°C] |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.covariance import from_upper
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.suggest import did_you_mean

BoolArray = NDArray[np.bool_]

POSITION = ("x", "y", "z")
SIGMA = ("sx", "sy", "sz")
COVARIANCE = ("cxx", "cxy", "cxz", "cyy", "cyz", "czz")
CENTRES = ("ul", "vl", "ur", "vr")
ORIENTATION = ("qx", "qy", "qz", "qw")
OPTIONAL_GROUPS = (SIGMA, COVARIANCE, CENTRES, ORIENTATION)
RESERVED = ("t", "segment", *POSITION, *SIGMA, *COVARIANCE, *CENTRES, *ORIENTATION)
EXTRA_PREFIXES = ("current_", "temperature_")


class ColumnLimits:
    quaternion_tolerance = 1e-3
    largest_position = 1e9  # of an arm in any unit of length; which one it is, is checked where the robot is known
    largest_segment = 2.0**53
    smallest_sigma_m, largest_sigma_m = 1e-100, 1e100  # their squares are still numbers
    # More columns than any arm needs, and ten hours at 100 samples/s with 27 columns.
    max_columns, max_numbers = 1000, 100_000_000
    longest_name = 200


_ROW_REMEDY = "Fix or delete the row"


class Fault(Exception):
    """Error in a table. The reader adds the file and converts the row to a line.

    Attributes:
        row: index of the row, from 0; None for the header.
        column: name of the column, or None.
    """

    def __init__(self, what: str, *, row: int | None = None, column: str | None = None, remedy: str = "") -> None:
        self.what, self.row, self.column, self.remedy = what, row, column, remedy
        super().__init__(what)

    def moved(self, rows: int) -> Fault:
        """Return the fault of a part that begins at row `rows`, with its row counted in the whole table."""
        return Fault(self.what, row=(self.row or 0) + rows, column=self.column, remedy=self.remedy)


@dataclass(frozen=True, slots=True)
class Table:
    """Named columns of numbers."""

    names: tuple[str, ...]  # names of the columns
    values: FloatArray  # shape (n, number of columns)

    def columns(self, names: tuple[str, ...]) -> FloatArray:
        """Return the columns `names`, shape (n, len(names))."""
        return self.values[:, [self.names.index(name) for name in names]]

    def has(self, names: tuple[str, ...]) -> bool:
        """Return True if the first of `names` is present (the header check ensures complete groups)."""
        return names[0] in self.names


def extra_columns(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(prefix + joint for prefix in EXTRA_PREFIXES for joint in joints)


def check_joints(joints: tuple[str, ...]) -> None:
    """Raise Fault if a joint's name cannot be the name of a column."""
    for joint in joints:
        if "," in joint or joint != joint.strip() or not joint.isprintable():
            raise Fault(f"a joint called {joint!r} cannot name a column", remedy="Rename the joint")
        if joint in RESERVED or joint in extra_columns(joints):
            raise Fault(
                f"a joint called {joint!r} would have the name of the column {joint!r}", remedy="Rename the joint"
            )


def check_width(names: Sequence[str]) -> None:
    """Raise Fault when there are more columns than a recording can have."""
    if len(names) > ColumnLimits.max_columns:
        what = f"there are {len(names):,} columns; a recording has at most {ColumnLimits.max_columns:,}"
        raise Fault(what, remedy="Delete those that are none of a recording's")
    for name in names:
        if len(name) > ColumnLimits.longest_name:
            remedy = f"Give it at most {ColumnLimits.longest_name}"
            raise Fault(f"a column's name has {len(name):,} characters", remedy=remedy)


def check_header(names: tuple[str, ...], joints: tuple[str, ...]) -> None:
    """Raise Fault unless `names` are the columns of a recording of `joints`."""
    check_joints(joints)
    check_width(names)
    for name in names:
        if names.count(name) > 1:
            raise Fault("two columns have this name", column=name, remedy="Rename or delete one of them")
    known = (*joints, *RESERVED, *extra_columns(joints))
    unknown = [name for name in names if name not in known]
    for name in (*joints, *POSITION):
        if name not in names:
            kind = "joint" if name in joints else "marker coordinate"
            raise Fault(f"there is no column for the {kind} {name!r}", column=name, remedy=_missing(name, unknown))
    for group in OPTIONAL_GROUPS:
        present = [name for name in group if name in names]
        if present and len(present) < len(group):
            absent = next(name for name in group if name not in names)
            raise Fault(f"{', '.join(present)} without {absent}", column=absent, remedy=f"Give all of {_list(group)}")
    if unknown:
        raise Fault(
            "unknown column", column=unknown[0], remedy=f"{did_you_mean(unknown[0], known)} Otherwise delete the column"
        )
    if SIGMA[0] in names and COVARIANCE[0] in names:
        raise Fault("both sigmas and covariances are given", column="sx", remedy=f"Delete {_list(SIGMA)}")


def check_finite(table: Table) -> None:
    """Raise Fault at the first number, row by row, that is not finite."""
    bad = ~np.isfinite(table.values)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        value = table.values[row, column]
        raise Fault(f"{value} is not a finite number", row=int(row), column=table.names[column], remedy=_ROW_REMEDY)


def check_values(table: Table) -> None:
    """Raise Fault at the first invalid finite value: times, positions, segments, sigmas, covariances, quaternions."""
    if table.has(("t",)):
        _check_time(table)
    if table.has(POSITION):
        for name, x in zip(POSITION, table.columns(POSITION).T, strict=True):
            far = np.abs(x) > ColumnLimits.largest_position
            _first(far, lambda row, x=x: f"{float(x[row])!r} is no position in metres", name)
    if table.has(("segment",)):
        segment = table.columns(("segment",))[:, 0]
        bad = (segment != np.round(segment)) | (np.abs(segment) > ColumnLimits.largest_segment)
        _first(bad, lambda row: f"{segment[row]!r} is not a whole number", "segment")
    if table.has(SIGMA):
        for name, sigma in zip(SIGMA, table.columns(SIGMA).T, strict=True):
            bad = ~((sigma >= ColumnLimits.smallest_sigma_m) & (sigma <= ColumnLimits.largest_sigma_m))
            _first(bad, lambda row, s=sigma: f"{float(s[row])!r} is no sigma: it has to be a positive length", name)
    if table.has(COVARIANCE):
        bad = ~positive_definite(from_upper(table.columns(COVARIANCE)))
        _first(bad, lambda _: "the covariance is not positive definite", "cxx", "Give variances above zero")
    if table.has(ORIENTATION):
        with np.errstate(over="ignore"):
            length = np.linalg.norm(table.columns(ORIENTATION), axis=1)
        bad = ~(np.abs(length - 1.0) <= ColumnLimits.quaternion_tolerance)
        _first(bad, lambda row: f"the quaternion has the length {length[row]:.6g}, not 1", "qx", "Normalise it")


def positive_definite(cov: FloatArray) -> BoolArray:
    """Return a mask (n,) of the symmetric matrices (n, 3, 3) that are positive definite, independent of their scale."""
    variances = np.diagonal(cov, axis1=1, axis2=2)
    good: BoolArray = np.asarray((variances > 0).all(axis=1))
    scale = np.sqrt(np.where(variances > 0, variances, 1.0))
    correlation = cov / scale[:, :, None] / scale[:, None, :]
    good &= np.isfinite(correlation).all(axis=(1, 2))
    good[good] = np.linalg.eigvalsh(correlation[good])[:, 0] > np.finfo(np.float64).eps
    return good


def _check_time(table: Table) -> None:
    t = table.columns(("t",))[:, 0]
    late = np.concatenate([[False], np.diff(t) <= 0])
    if table.has(("segment",)):
        segment = table.columns(("segment",))[:, 0]
        late[1:] &= segment[1:] == segment[:-1]
    _first(
        late,
        lambda row: f"the time {float(t[row])!r} does not come after {float(t[row - 1])!r}",
        "t",
        "Sort the rows by time, or start a new segment where the clock was reset",
    )


def _first(bad: BoolArray, what: Callable[[int], str], column: str, remedy: str = _ROW_REMEDY) -> None:
    rows = np.flatnonzero(bad)
    if len(rows):
        raise Fault(what(int(rows[0])), row=int(rows[0]), column=column, remedy=remedy)


def _missing(name: str, unknown: list[str]) -> str:
    named = f"The columns are named after the joints of robot.toml and x, y, z; not understood: {_list(unknown[:10])}"
    return named if unknown else f"Add the column {name!r}"


def shortened(text: str) -> str:
    """Return a quoted excerpt of a text from a file, short enough for a message."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _list(names: Iterable[str]) -> str:
    return ", ".join(names)
