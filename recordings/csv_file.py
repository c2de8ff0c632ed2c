"""Read and write recordings as CSV: a header, then numbers, with enough digits to restore every float exactly."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.limited import opened

from .columns import ColumnLimits, Fault, Table, check_finite, check_header, check_width, shortened

FIRST_ROW_LINE = 2


class _Settings:
    # Limits of a file and of a line: a thousand columns of 25 digits take 25 KiB.
    max_bytes, max_line_bytes = 2**30, 2**20
    # Size of a parsed block: large enough to hide Python's overhead, small compared with the numbers of a recording.
    block_bytes = 2**22


def read_csv_table(file: Path, joints: tuple[str, ...]) -> Table:
    """Return the numbers in `file`, all finite, under a checked header.

    Raises:
        Fault: the text is invalid; rows count from 0 below the header.
        OSError: the file cannot be read.
    """
    blocks: list[FloatArray] = []
    rows, whole = 0, True
    with opened(file, _Settings.max_bytes) as stream:
        names = _header(stream)
        _check_header_line(names, joints)
        while data := _block(stream, rows):
            whole = data.endswith(b"\n")
            try:
                blocks.append(_numbers(_lines(_decoded(data)), names, whole))
            except Fault as fault:
                raise fault.moved(rows) from None
            rows += len(blocks[-1])
            if rows * len(names) > ColumnLimits.max_numbers:
                most = ColumnLimits.max_numbers // len(names)
                raise Fault(f"there are more than {most:,} rows of these columns", remedy="Cut the recording")
    if not rows:
        raise Fault("there are no rows below the header", remedy="Record at least one sample")
    table = Table(names, np.concatenate(blocks))
    check_finite(table)
    if not whole:
        raise Fault(
            "the last line has no line end, so its last number may be cut off",
            row=rows - 1,
            column=names[-1],
            remedy="Add a line end if the number is whole, otherwise delete the line",
        )
    return table


def csv_columns(file: Path) -> tuple[str, ...]:
    """Return the names of the columns of `file`.

    Raises:
        Fault: it is not text, or empty.
        OSError: it cannot be read.
    """
    with opened(file, _Settings.max_bytes) as stream:
        names = _header(stream)
    check_width(names)
    return names


def write_csv_rows(out: TextIO, rows: Iterable[Iterable[float]], integers: frozenset[int]) -> None:
    """Append rows; columns whose index is in `integers` are written without a decimal point."""
    out.writelines(
        ",".join(repr(int(value)) if index in integers else repr(value) for index, value in enumerate(row)) + "\n"
        for row in rows
    )


def _header(stream: BinaryIO) -> tuple[str, ...]:
    """Return the names in the first line. Raise Fault where it is missing or not text."""
    line = _line(stream, -1)
    try:
        header = _lines(_decoded(line))[0] if line else ""
    except Fault as fault:
        raise fault.moved(-1) from None
    if not header.strip() and not stream.read(_Settings.max_line_bytes).strip():
        raise Fault("the file is empty", remedy="A recording has a header line and at least one row")
    for letter in header:
        if not letter.isprintable() and letter != "\t":
            what = f"this is not a text file: its first line has the character {letter!r}"
            raise Fault(what, row=-1, remedy="Name a CSV file")
    return tuple(name.strip() for name in header.split(","))


def _block(stream: BinaryIO, row: int) -> bytes:
    """Return the next lines, empty at the end of the file."""
    data = bytearray()
    while len(data) < _Settings.block_bytes and (line := _line(stream, row)):
        data += line
        row += 1
    return bytes(data)


def _line(stream: BinaryIO, row: int) -> bytes:
    line = stream.readline(_Settings.max_line_bytes + 1)
    if len(line) > _Settings.max_line_bytes:
        raise Fault("the line is longer than 1 MiB", row=row, remedy="Name a CSV file")
    return line


def _lines(text: str) -> list[str]:
    return [line.removesuffix("\r") for line in text.removesuffix("\n").split("\n")]


def _decoded(data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Fault(
            f"the byte 0x{data[error.start]:02x} is not UTF-8 text",
            row=data.count(b"\n", 0, error.start),
            remedy="Save the recording as CSV in UTF-8, without quotes",
        ) from error


def _check_header_line(names: tuple[str, ...], joints: tuple[str, ...]) -> None:
    check_width(names)
    if len(names) == 1 and (";" in names[0] or "\t" in names[0]):
        raise Fault("the columns are not separated by commas", remedy="Save the recording with commas between columns")
    if all(_number(name) is not None for name in names):
        raise Fault("the first line has numbers where the names of the columns should be", remedy="Add a header line")
    check_header(names, joints)


def _numbers(lines: list[str], names: tuple[str, ...], whole: bool) -> FloatArray:
    """Parse all rows at once. If that fails, examine the fields one by one."""
    strict = all(line.isascii() and "_" not in line for line in lines)  # float() accepts "1_0" and non-ASCII digits
    if strict and all(_width(line) == len(names) for line in lines):
        fields = chain.from_iterable(line.split(",") for line in lines)
        try:
            flat = np.fromiter(map(float, fields), dtype=np.float64, count=len(lines) * len(names))
        except ValueError:
            pass
        else:
            return flat.reshape(len(lines), len(names))
    raise _first_wrong_field(lines, names, whole)


def _width(line: str) -> int:
    """Return the number of fields of a line without splitting it: a hostile line has millions."""
    return line.count(",") + 1


def _first_wrong_field(lines: list[str], names: tuple[str, ...], whole: bool) -> Fault:
    for index, line in enumerate(lines):
        if _width(line) != len(names):
            return _wrong_width(lines, index, names, whole)
        for name, text in zip(names, line.split(","), strict=True):
            if _number(text) is None:
                what = "the field is empty" if not text.strip() else f"{shortened(text)} is not a number"
                return Fault(what, row=index, column=name, remedy="Write it like -0.5 or 1e-3, without quotes")
    raise AssertionError("every field is a number")


def _wrong_width(lines: list[str], index: int, names: tuple[str, ...], whole: bool) -> Fault:
    width = _width(lines[index])
    if index == len(lines) - 1 and not whole:
        return Fault("the last line is torn: the recording was cut off here", row=index, remedy="Delete this line")
    if not lines[index]:
        return Fault("the line is empty", row=index, remedy="Delete the line")
    what = f"{width} field{'s' if width > 1 else ''} where the header names {len(names)}"
    column = names[width] if width < len(names) else None
    return Fault(what, row=index, column=column, remedy="Fix or delete the line")


def _number(text: str) -> float | None:
    if not text.isascii() or "_" in text:
        return None
    try:
        return float(text)
    except ValueError:
        return None
