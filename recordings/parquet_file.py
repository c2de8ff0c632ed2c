"""Read and write recordings as Parquet. Needs the extra `export`."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.extras import install_command
from bodyschema.robot.limited import FileLimits, bounded_memory, opened

from .columns import ColumnLimits, Fault, Table, check_finite, check_header, check_width

MAX_BYTES = 2**30  # the largest number of values takes 0.8 GB
INTEGER_COLUMNS = frozenset({"segment"})


def read_parquet_table(file: Path, joints: tuple[str, ...]) -> Table:
    """Return the numbers in `file`, all finite, under a checked header.

    Raises:
        RecordingError: the extra `export` is not installed.
        Fault: the content of the file is invalid.
        OSError: the file cannot be read.
    """
    arrow, _ = arrow_modules(file, "Parquet, unlike CSV,")
    with _opened(file) as parquet:
        names = tuple(parquet.schema_arrow.names)
        check_header(names, joints)
        for name in names:
            kind = parquet.schema_arrow.field(name).type
            if not (arrow.types.is_floating(kind) or arrow.types.is_integer(kind)):
                raise Fault(f"the column holds {kind}, not numbers", column=name, remedy="Write it as double")
        content = _read(arrow, parquet)
    if content.num_rows == 0:
        raise Fault("there are no rows", remedy="Record at least one sample")
    values = np.column_stack([_column(name, content.column(name)) for name in names])
    table = Table(names, values)
    check_finite(table)
    return table


def parquet_columns(file: Path) -> tuple[str, ...]:
    """Return the names of the columns of `file`. Raise the errors of `read_parquet_table`."""
    with _opened(file) as parquet:
        names = tuple(parquet.schema_arrow.names)
    check_width(names)
    return names


def _read(arrow: Any, parquet: Any) -> Any:
    """Read all columns; raise Fault if there are too many numbers, even if the metadata claims fewer.

    A file of some kilobytes can hold billions of equal numbers.
    """
    most = ColumnLimits.max_numbers // len(parquet.schema_arrow)
    _check_rows(parquet.metadata.num_rows, most)
    batches, rows = [], 0
    for batch in parquet.iter_batches():
        rows += batch.num_rows
        _check_rows(rows, most)
        batches.append(batch)
    return arrow.Table.from_batches(batches, parquet.schema_arrow)


def _check_rows(rows: int, most: int) -> None:
    if rows > most:
        raise Fault(f"there are {rows:,} rows; of these columns at most {most:,} are read", remedy="Cut the recording")


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """Open the Parquet file; raise Fault if the content read inside the with block is damaged."""
    arrow, parquet = arrow_modules(file, "Parquet, unlike CSV,")
    with bounded_memory(FileLimits.memory_bytes), opened(file, MAX_BYTES) as stream:
        try:
            yield parquet.ParquetFile(stream)
        except (arrow.ArrowException, OSError, ValueError) as error:
            raise Fault(
                f"not a whole Parquet file: {_first_line(error)}",
                remedy="Write it again; a Parquet file whose writing was cut off cannot be read",
            ) from error


def write_parquet_table(file: Path, table: Table) -> None:
    """Write `table` to `file`.

    Raises:
        RecordingError: the extra `export` is not installed.
        OSError: the file cannot be written.
    """
    arrow, parquet = arrow_modules(file, "Parquet, unlike CSV,")
    columns = {
        name: arrow.array(column.astype(np.int64) if name in INTEGER_COLUMNS else column)
        for name, column in zip(table.names, table.values.T, strict=True)
    }
    with file.open("wb") as stream:
        parquet.write_table(arrow.table(columns), stream)


def _column(name: str, column: Any) -> np.ndarray:
    if column.null_count:
        row = int(np.flatnonzero(column.is_null().to_numpy())[0])
        raise Fault("the value is missing", row=row, column=name, remedy="Fix or delete the row")
    return column.to_numpy().astype(np.float64)


def arrow_modules(file: Path, what: str) -> tuple[Any, Any]:
    """Return pyarrow and pyarrow.parquet, which `what` needs; raise RecordingError if they are not installed."""
    return imported("pyarrow", "export", what, file), imported("pyarrow.parquet", "export", what, file)


def imported(module: str, extra: str, what: str, file: Path) -> Any:
    """Return a module of an optional package, which `what` needs; raise RecordingError if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        remedy = f"Type: {install_command(extra)}"
        raise RecordingError(f"{what} needs the extra `{extra}`", file=file, remedy=remedy) from error


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0].rstrip(".")
