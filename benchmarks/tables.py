"""Tables of figures, from a benchmark to its page: `python -m benchmarks.tables` writes those of docs/.

With `--tables docs/results/tables` a benchmark writes each table that it prints to NAME.json there. A page shows it
between the markers `<!-- table: NAME -->` and `<!-- end -->`, with the command that measured it.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"
FOLDER = DOCS / "results" / "tables"
OPTION = "--tables"
BLOCK = re.compile(r"(?<=<!-- table: )(\w+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)
# A cell of another table, as in {ball_accuracy/usual/no fix [%]}: its table, the first cell of its row, its column.
REFERENCE = re.compile(r"\{(\w+)/([^/{}]+)/([^/{}]+)\}")
MINUS = re.compile(r"(?<![\w.])-(?=\d)")
DIGITS = 6  # of a number in a file; pages show fewer
Cell = float | str | Sequence[float] | None


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        format: of the numbers of a cell, as in "{:.1f}" or "{} of {}"; a column without one holds words.
    """

    name: str
    unit: str = ""
    format: str = ""

    @property
    def heading(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def shown(self, cell: Cell) -> str:
        """Return a cell as text; words stay as they are."""
        if cell is None or isinstance(cell, str):
            return cell or ""
        numbers = [cell] if isinstance(cell, int | float) else list(cell)
        return MINUS.sub("−", (self.format or "{:g}").format(*numbers))


class Table:
    """A table that grows by rows, each printed as it comes.

    Args:
        name: of its file.
        commands: what measured it; the running command if not given.
    """

    def __init__(self, name: str, columns: Sequence[Column], commands: Iterable[str] | None = None) -> None:
        self.name = name
        self.columns = tuple(columns)
        self.rows: list[list[Cell]] = []
        self.commands = [running()] if commands is None else list(commands)

    @classmethod
    def load(cls, name: str, folder: Path = FOLDER) -> Table:
        content = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        table = cls(name, [Column(**column) for column in content["columns"]], content["commands"])
        table.rows = content["rows"]
        return table

    @classmethod
    def of(cls, name: str, columns: Sequence[Column], rows: Iterable[Sequence[object]], command: str) -> Table:
        """Return a table of these rows; nothing is printed."""
        table = cls(name, columns, [command])
        table.rows = [[_plain(cell) for cell in row] for row in rows]
        return table

    def add(self, *cells: object) -> None:
        """Append a row and print it: numbers, sequences of numbers, words, or None for an empty cell."""
        if len(cells) != len(self.columns):
            raise ValueError(f"{len(cells)} cells for {len(self.columns)} columns")
        if not self.rows:
            print("\n".join(self._head()))
        self.rows.append([_plain(cell) for cell in cells])
        print(self._line(self.rows[-1]), flush=True)

    def save(self, folder: Path | None) -> None:
        """Write the table to its file in a folder, if there is one."""
        if folder is None:
            return
        columns = [
            {key: text for key, text in asdict(column).items() if text or key == "name"} for column in self.columns
        ]
        parts = [
            f'"commands": {json.dumps(self.commands, ensure_ascii=False)}',
            f'"columns": {_listed(columns)}',
            f'"rows": {_listed(self.rows)}',
        ]
        (folder / f"{self.name}.json").write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")

    def cell(self, row: str, heading: str) -> str:
        """Return the text of a cell; raise KeyError if there is no such row or column."""
        columns = {column.heading: column for column in self.columns}
        rows = {str(cells[0]): cells for cells in self.rows}
        return columns[heading].shown(rows[row][list(columns).index(heading)])

    def markdown(self, folder: Path = FOLDER) -> str:
        """Return the table in Markdown, cells of other tables in the place of references to them."""
        lines = [*self._head(), *(_filled(self._line(row), folder) for row in self.rows)]
        if self.commands:
            lines += ["", f"Measured with {', '.join(f'`{command}`' for command in self.commands)}."]
        return "\n".join(lines)

    def _head(self) -> list[str]:
        rules = ["---:" if column.format else "---" for column in self.columns]
        return [_row([column.heading for column in self.columns]), _row(rules)]

    def _line(self, row: Sequence[Cell]) -> str:
        return _row([column.shown(cell) for column, cell in zip(self.columns, row, strict=True)])


def tables_option(parser: argparse.ArgumentParser) -> None:
    """Add the option that writes tables."""
    parser.add_argument(OPTION, type=Path, metavar="FOLDER", help="write each table to a file there, for docs/results")


def running() -> str:
    """Return the running command without the option of tables; of files outside of the checkout only the names."""
    words = ["python", *sys.orig_argv[1:]]
    if OPTION in words:
        del words[words.index(OPTION) : words.index(OPTION) + 2]
    return shlex.join(Path(word).name if Path(word).is_absolute() else word for word in words if word != "-u")


def rendered(page: str, folder: Path = FOLDER) -> str:
    """Return a page with the tables that its markers name."""
    return BLOCK.sub(lambda match: f"{match[1]}{match[2]}\n{Table.load(match[1], folder).markdown(folder)}\n\n", page)


def pages() -> list[Path]:
    """Return the pages that may have tables."""
    return sorted(DOCS.rglob("*.md"))


def _filled(text: str, folder: Path) -> str:
    return REFERENCE.sub(lambda match: Table.load(match[1], folder).cell(match[2], match[3]), text)


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _listed(items: Iterable[object]) -> str:
    return "[\n" + ",\n".join(f"  {json.dumps(item, ensure_ascii=False)}" for item in items) + "\n]"


def _plain(cell: object) -> Cell:
    """Return a cell that JSON can hold: NumPy's numbers as Python's, with as many digits as are worth keeping."""
    if cell is None or isinstance(cell, str):
        return cell
    if isinstance(cell, int):
        return int(cell)
    if isinstance(cell, Iterable):
        return [_number(each) for each in cell]
    return _number(cell)


def _number(value: object) -> float:
    number = float(value)  # pyright: ignore[reportArgumentType]
    return int(number) if isinstance(value, int) else float(f"{number:.{DIGITS}g}")


def main() -> None:
    """Write the tables of all pages."""
    for page in pages():
        before = page.read_text(encoding="utf-8")
        after = rendered(before)
        if after != before:
            page.write_text(after, encoding="utf-8")
            print(page.relative_to(DOCS))


if __name__ == "__main__":
    main()
