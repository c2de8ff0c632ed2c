"""Recordings: many pairs on disk, as CSV or Parquet (columns: `bodyschema.recordings.columns`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Self, TextIO

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.covariance import from_upper, upper_triangles
from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import FloatArray, frozen_array
from bodyschema.interfaces.whole_files import raising_write_errors
from bodyschema.robot.limited import UnfitFile

from .columns import (
    CENTRES,
    COVARIANCE,
    EXTRA_PREFIXES,
    ORIENTATION,
    POSITION,
    RESERVED,
    SIGMA,
    Fault,
    Table,
    check_finite,
    check_header,
    check_values,
    extra_columns,
)
from .csv_file import FIRST_ROW_LINE, csv_columns, read_csv_table, write_csv_rows
from .parquet_file import INTEGER_COLUMNS, parquet_columns, read_parquet_table, write_parquet_table

CSV, PARQUET = ".csv", ".parquet"


class RecordingSettings:
    row_interval_s = 1 / 30  # between rows without times, the rate of the usual cameras
    reset_gap_s = 10.0  # between runs whose clocks have nothing to do with each other


@dataclass(frozen=True, eq=False)
class Recording:
    """Many pairs, in the order in which they were measured.

    Raises:
        RecordingError: a value is impossible; the message names row (of a CSV file: line) and column.
        ValueError: the arrays' shapes do not fit each other.
    """

    joints: tuple[str, ...]  # names in the order of q
    q: FloatArray  # joint angles [rad] (m for a prismatic joint), shape (n, d)
    x: FloatArray  # marker positions in the measurement frame [m], shape (n, 3)
    t: FloatArray | None = None  # times [s], shape (n,), strictly increasing inside a segment, or None
    cov: FloatArray | None = None  # covariances of x [m²], shape (n, 3, 3), or None
    segment: NDArray[np.int64] | None = None  # numbers of the runs, shape (n,), or None
    centres_px: FloatArray | None = None  # (ul, vl, ur, vr) [px], shape (n, 4), or None
    orientation: FloatArray | None = None  # unit quaternions (x, y, z, w), shape (n, 4), or None
    # the columns current_<joint> [A] and temperature_<joint> [°C] that are there, each of shape (n,)
    extra: Mapping[str, FloatArray] = field(default_factory=dict)
    file: Path | None = None  # where it was read from, or None

    def __post_init__(self) -> None:
        for name in ("q", "x", "t", "cov", "centres_px", "orientation"):
            value = getattr(self, name)
            object.__setattr__(self, name, None if value is None else frozen_array(value))
        if self.segment is not None:
            segment = np.array(self.segment, dtype=np.int64)
            segment.setflags(write=False)
            object.__setattr__(self, "segment", segment)
        extra = {name: frozen_array(column) for name, column in self.extra.items()}
        object.__setattr__(self, "extra", MappingProxyType(extra))
        self._check_shapes()
        try:
            table = self.to_table()
            check_header(table.names, self.joints)
            check_finite(table)
            check_values(table)
        except Fault as fault:
            raise _located(fault, self.file) from None

    def __len__(self) -> int:
        return len(self.q)

    @property
    def play_times(self) -> FloatArray:
        """Strictly increasing times to play the rows at [s], shape (n,).

        They are the recording's own times, shifted where its clock was reset between segments. Without times the rows
        are a thirtieth of a second apart.
        """
        if self.t is None:
            return frozen_array(np.arange(len(self)) * RecordingSettings.row_interval_s)
        steps = np.diff(self.t)
        if (steps > 0).all():
            return self.t
        moved = self.t[0] + np.cumsum(np.append(0.0, np.where(steps > 0, steps, RecordingSettings.reset_gap_s)))
        strictly = bool((np.diff(moved) > 0).all())  # steps far below the size of the times are lost in rounding
        return frozen_array(moved if strictly else np.arange(len(self)) * RecordingSettings.row_interval_s)

    @classmethod
    def read(cls, file: Path | str, joints: tuple[str, ...]) -> Self:
        """Read the recording in `file`, CSV or Parquet by its suffix.

        Args:
            joints: the robot's joints in the order of q; each needs a column.

        Raises:
            RecordingError: the file cannot be read; the message names line, column and remedy.
        """
        file, joints = Path(file), tuple(joints)
        table = read_table(file, joints)
        return cls.from_table(table, joints, file)

    @classmethod
    def from_table(cls, table: Table, joints: tuple[str, ...], file: Path | None = None) -> Self:
        """Build the recording from a table with a checked header."""

        def optional(names: tuple[str, ...]) -> FloatArray | None:
            return table.columns(names) if table.has(names) else None

        sigma, upper = optional(SIGMA), optional(COVARIANCE)
        cov = None if upper is None else from_upper(upper)
        if sigma is not None:
            cov = np.zeros((len(sigma), 3, 3))
            cov[:, range(3), range(3)] = sigma**2
        t, segment = optional(("t",)), optional(("segment",))
        return cls(
            joints=joints,
            q=table.columns(joints),
            x=table.columns(POSITION),
            t=None if t is None else t[:, 0],
            cov=cov,
            segment=None if segment is None else segment[:, 0].astype(np.int64),
            centres_px=optional(CENTRES),
            orientation=optional(ORIENTATION),
            extra={name: table.columns((name,))[:, 0] for name in table.names if name in extra_columns(joints)},
            file=file,
        )

    def to_table(self) -> Table:
        """All columns; covariances always as their upper triangle, so that they are restored exactly."""
        blocks: list[tuple[tuple[str, ...], FloatArray]] = []
        if self.t is not None:
            blocks.append((("t",), self.t[:, None]))
        if self.segment is not None:
            blocks.append((("segment",), self.segment[:, None].astype(np.float64)))
        blocks += [(self.joints, self.q), (POSITION, self.x)]
        if self.cov is not None:
            blocks.append((COVARIANCE, upper_triangles(self.cov)))
        if self.centres_px is not None:
            blocks.append((CENTRES, self.centres_px))
        if self.orientation is not None:
            blocks.append((ORIENTATION, self.orientation))
        blocks += [((name,), column[:, None]) for name, column in self.extra.items()]
        names = tuple(name for group, _ in blocks for name in group)
        return Table(names, np.hstack([values for _, values in blocks]))

    def write_csv(self, file: Path) -> None:
        """Write CSV; reading it restores every number exactly.

        Raises:
            RecordingError: the file cannot be written.
        """
        with raising_write_errors(file, RecordingError), file.open("w", encoding="utf-8", newline="\n") as out:
            self.write_csv_to(out)

    def write_csv_to(self, out: TextIO) -> None:
        """Write CSV to an open file; raise OSError if that fails."""
        table = self.to_table()
        integers = frozenset(i for i, name in enumerate(table.names) if name in INTEGER_COLUMNS)
        out.write(",".join(table.names) + "\n")
        write_csv_rows(out, table.values.tolist(), integers)

    def write_parquet(self, file: Path) -> None:
        """Write Parquet; reading it restores every number exactly.

        Raises:
            RecordingError: the file cannot be written, or the extra `export` is not installed.
        """
        with raising_write_errors(file, RecordingError):
            write_parquet_table(file, self.to_table())

    def rows(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Recording:
        """Return a recording of the rows selected by a mask or by indices."""

        def pick(values: FloatArray | None) -> FloatArray | None:
            return None if values is None else values[chosen]

        return Recording(
            joints=self.joints,
            q=self.q[chosen],
            x=self.x[chosen],
            t=pick(self.t),
            cov=pick(self.cov),
            segment=None if self.segment is None else self.segment[chosen],
            centres_px=pick(self.centres_px),
            orientation=pick(self.orientation),
            extra={name: column[chosen] for name, column in self.extra.items()},
        )

    def _check_shapes(self) -> None:
        n, d = self.q.shape if self.q.ndim == 2 else (-1, -1)
        if n < 1 or d != len(self.joints):
            raise ValueError(f"q has the shape {self.q.shape}, not (n, {len(self.joints)}) with n of at least 1")
        shapes = {"x": (n, 3), "t": (n,), "cov": (n, 3, 3), "segment": (n,), "centres_px": (n, 4)}
        shapes["orientation"] = (n, 4)
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"{name} has the shape {value.shape}, not {shape}")
        for name, column in self.extra.items():
            if column.shape != (n,):
                raise ValueError(f"extra column {name} has the shape {column.shape}, not {(n,)}")
        if self.cov is not None and not (self.cov == np.swapaxes(self.cov, 1, 2)).all():
            raise ValueError("cov is not symmetric")


def read_table(file: Path, joints: tuple[str, ...]) -> Table:
    """Return the checked columns of a recording of `joints` in `file`, CSV or Parquet by its ending.

    Raises:
        RecordingError: the file cannot be read; the message names line, column and remedy.
    """
    with _explained(file):
        table = {CSV: read_csv_table, PARQUET: read_parquet_table}[file.suffix.lower()](file, joints)
        check_values(table)
    return table


def joints_in(file: Path) -> tuple[str, ...]:
    """Return the joints of a recording, in column order: all columns whose name has no other meaning.

    Raises:
        RecordingError: the file cannot be read.
    """
    with _explained(file):
        names = {CSV: csv_columns, PARQUET: parquet_columns}[file.suffix.lower()](file)
    others = {prefix + name for prefix in EXTRA_PREFIXES for name in names}
    joints = tuple(name for name in names if name not in RESERVED and name not in others)
    if not joints:
        raise RecordingError("no column is a joint's", file=file, remedy="Name a recording of joints and positions")
    return joints


@contextmanager
def _explained(file: Path) -> Iterator[None]:
    """Convert errors of reading `file` to RecordingError, after a check of its ending."""
    try:
        if file.suffix.lower() not in (CSV, PARQUET):
            file.stat()  # a wrong path is more likely than a damaged file
            raise RecordingError(f"recordings end in {CSV} or {PARQUET}", file=file, remedy="Rename or convert it")
        yield
    except Fault as fault:
        raise _located(fault, file) from None
    except OSError as error:
        raise _unreadable(file, error) from error


def _unreadable(file: Path, error: OSError) -> RecordingError:
    if isinstance(error, UnfitFile):
        return RecordingError(str(error.strerror), file=file, remedy="Name a recording of at most 1 GiB")
    if isinstance(error, FileNotFoundError):
        return RecordingError("there is no such file", file=file, remedy="Name a recording that is there")
    if isinstance(error, IsADirectoryError):
        return RecordingError("a folder, not a file", file=file, remedy="Name the recording in it")
    return RecordingError(f"cannot be read: {error.strerror or error}", file=file, remedy="Fix its permissions")


def _located(fault: Fault, file: Path | None) -> RecordingError:
    where = "recording" if file is None else file
    if file is not None and file.suffix.lower() == CSV:
        line = 1 if fault.row is None and fault.column is not None else None
        line = fault.row + FIRST_ROW_LINE if fault.row is not None else line
        return RecordingError(fault.what, file=where, line=line, column=fault.column, remedy=fault.remedy)
    what = fault.what if fault.row is None else f"row {fault.row + 1}: {fault.what}"
    return RecordingError(what, file=where, column=fault.column, remedy=fault.remedy)
