"""Pages of results show the tables that were measured, and their prose no seeds, dates or former versions."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.tables import BLOCK, DOCS, FOLDER, Column, Table, pages, rendered

RESULTS = sorted((DOCS / "results").glob("*.md"))
FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
# A table of words alone may stand outside of markers; one with digits in its words says so.
TABLES = re.compile(r"(?:(?<=<!-- words -->\n\n)|(?<=\n\n))(?:\|.*\n)+")
OF_A_RUN = re.compile(r"\b20\d\d-\d\d-\d\d\b|--(?:first-)?seed|\bseeds? \d|(?<![\d,.–+·⁰¹²-])\b\d{5,}\b(?!\])")
FORMER = re.compile(
    r"\b(?:earlier code|present code|code before|used to|mended since|formerly|previously)\b", re.IGNORECASE
)


def outside(page: Path) -> str:
    """Return the prose of a page: without its generated tables and without code."""
    return FENCED.sub("", BLOCK.sub("", page.read_text(encoding="utf-8")))


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_a_page_shows_its_tables_as_measured(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert rendered(text) == text, "run python -m benchmarks.tables"


@pytest.mark.parametrize("page", RESULTS, ids=lambda page: page.name)
def test_every_table_of_figures_is_generated(page: Path) -> None:
    text = outside(page)
    for match in TABLES.finditer(text):
        words = text[: match.start()].endswith("<!-- words -->\n\n")
        assert words or not re.search(r"\d", match[0]), match[0].splitlines()[0]


@pytest.mark.parametrize("page", RESULTS, ids=lambda page: page.name)
def test_prose_has_no_seeds_dates_or_former_versions(page: Path) -> None:
    prose = re.sub(r"`[^`]*`|\]\([^)]*\)", "", outside(page))
    assert not OF_A_RUN.search(prose), OF_A_RUN.search(prose)
    assert not FORMER.search(prose), FORMER.search(prose)


def test_every_stored_table_is_on_a_page() -> None:
    shown = {match[1] for page in pages() for match in BLOCK.finditer(page.read_text(encoding="utf-8"))}
    assert {file.stem for file in FOLDER.glob("*.json")} == shown


def test_the_summary_has_at_most_600_words() -> None:
    assert len((DOCS / "results" / "index.md").read_text(encoding="utf-8").split()) <= 600


def test_a_table_is_read_as_it_was_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = Column("look"), Column("error", "mm", "{:.2f}"), Column("kept", "", "{} of {}")
    table = Table("one", columns, ["python -m benchmarks.one"])
    table.add("usual", -0.1234567, [3, 4])
    table.add("noisy", None, "–")
    table.save(tmp_path)
    again = Table.load("one", tmp_path)
    assert again.markdown() == table.markdown()
    assert table.markdown().splitlines()[:4] == capsys.readouterr().out.splitlines()
    assert again.cell("usual", "error [mm]") == "−0.12"
    assert again.cell("usual", "kept") == "3 of 4"


def test_a_table_can_show_cells_of_another(tmp_path: Path) -> None:
    first = Table("first", [Column("arm"), Column("error", "mm", "{:.1f}")], [])
    first.add("UR5", 0.11)
    first.save(tmp_path)
    summary = Table("summary", [Column("result")], [])
    summary.add("off by {first/UR5/error [mm]} mm")
    summary.save(tmp_path)
    assert "| off by 0.1 mm |" in rendered("<!-- table: summary -->\n<!-- end -->\n", tmp_path)


def test_command_of_table_omits_output_path() -> None:
    code = "from benchmarks.tables import running; print(running())"
    words = [sys.executable, "-c", code, "/somewhere/data", "--tables", "here", "--pairs", "3"]
    said = subprocess.run(words, cwd=DOCS.parent, capture_output=True, text=True, check=True).stdout
    assert said.endswith("data --pairs 3\n")
