"""Tables of docs/results/reproduced.md, from what `bodyschema reproduce --json > FILE` printed.

python -m benchmarks.reproduced FILE --tables docs/results/tables
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.tables import Column, Table, tables_option
from bodyschema.reproduce.show import mm

COMMAND = "bodyschema reproduce"
UNITS = {"m": "mm", "samples": "samples", "s": "s"}


def readings(experiment: Mapping[str, Any]) -> Table:
    """Return the figures of the paper beside those of its method, under each interpretation."""
    columns = [Column(name) for name in ("quantity", "read as", "paper")]
    columns.append(Column("its method, here", "", "{}"))
    rows, last = [], ""
    for reading in experiment["readings"]:
        said, last = ("" if reading["what"] == last else reading["what"]), reading["what"]
        paper = reading["paper"] if said else ""
        rows.append([said, reading["read_as"], paper, value(reading)])
    return Table.of(f"reproduced_{experiment['name']}", columns, rows, COMMAND)


def value(reading: Mapping[str, Any]) -> str:
    """Return a figure with its unit."""
    number, unit = reading["value"], UNITS[reading["unit"]]
    if number is None:
        return "not reached"
    return f"{mm(number) if unit == 'mm' else f'{number:,.3g}' if unit == 's' else f'{number:,.0f}'} {unit}"


def models(experiment: Mapping[str, Any]) -> Table:
    """Return the errors of other models on the same samples."""
    comparison = experiment["comparison"]
    columns = [Column("mean error", "mm"), *(Column(name, "", "{}") for name in comparison["rows"])]
    places = [f"{column['test']} at {column['count']:,}" for column in comparison["columns"]]
    errors = zip(*comparison["rows"].values(), strict=True)
    rows = [[place, *map(mm, each)] for place, each in zip(places, errors, strict=True)]
    return Table.of(f"reproduced_{experiment['name']}_models", columns, rows, COMMAND)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    tables_option(parser)
    given = parser.parse_args()
    for experiment in json.loads(given.file.read_text(encoding="utf-8"))["experiments"]:
        shown = [readings(experiment), *([models(experiment)] if experiment["comparison"] else [])]
        for table in shown:
            print(f"{table.markdown()}\n")
            table.save(given.tables)


if __name__ == "__main__":
    main()
