"""Messages for people use plain words: a list of what they avoid."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = (
    *("calibration", "cli", "daemon", "dashboard", "drivers", "fleet", "interfaces"),
    *("kbmaps", "learning", "recordings", "robot", "sim_backend"),
)
INSTEAD = {
    r"anew": "again",
    r"mend(s|ed|ing)?": "fix, correct",
    r"nobody": "no one, no program",
    r"somebody|whoever": "a program, the user",
    r"is told|are told|was told|be told": "is reported",
    r"tells (why|which|whether|of|how)|does not tell|cannot tell": "shows, reports",
    r"as drawn|is none": "nominal; is invalid",
    r"the judge|judged": "the evaluation",
}
WORDS = re.compile(rf"\b({'|'.join(INSTEAD)})\b", re.IGNORECASE)
SENTENCE = re.compile(r"\.\s+Raises? [A-Z]\w+")
# Docstrings and comments: what no native reader writes, and the openings that announce a question.
RIDDLES = re.compile(
    r"\b(?:after|at|by|from|in|of|to|with) so many\b(?! that)|\bso no more\b|\bas (?:it|they) ha(?:s|ve) it\b",
    re.IGNORECASE,
)
QUESTIONS = re.compile(r"(?:Whether|What|How|Who|Whose|Why)\b")
# The views of a diagnosis quote its sentences.
OF_DIAGNOSIS = re.compile(r"diagnosis_(run|view)\.py$")


def avoided(source: str, *, with_docstrings: bool) -> Iterator[str]:
    """Yield the avoided words in the messages of a module; docstrings are what `--help` prints of a command."""
    nodes = list(ast.walk(ast.parse(source)))
    skipped = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    if with_docstrings:
        commands = (node for node in nodes if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"))
        skipped -= {id(node.body[0].value) for node in commands if isinstance(node.body[0], ast.Expr)}
    for node in nodes:
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and " " in node.value
            and id(node) not in skipped
        ):
            yield from (f"line {node.lineno}: {found[0]}" for found in WORDS.finditer(node.value))


@pytest.mark.parametrize("room", ROOMS)
def test_messages_avoid_the_words_of_the_list(room: str) -> None:
    files = [file for file in (ROOT / room).rglob("*.py") if not OF_DIAGNOSIS.search(file.name)]
    found = {
        str(file.relative_to(ROOT)): words
        for file in files
        if (words := list(avoided(file.read_text("utf-8"), with_docstrings="commands" in file.parts)))
    }
    assert found == {}


def test_an_avoided_word_is_found() -> None:
    assert list(avoided('raise Error(f"{port} is opened anew")', with_docstrings=False)) == ["line 1: anew"]
    assert list(avoided('"""Nobody reads this."""', with_docstrings=False)) == []
    assert list(avoided('def run():\n    """Whoever runs."""', with_docstrings=True)) == ["line 2: Whoever"]


def in_sentences(source: str) -> Iterator[str]:
    """Yield the public docstrings that name an error in a sentence after the first, not under `Raises:`."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and re.match("[a-zA-Z]", node.name):
            yield from (f"line {node.lineno}: {node.name}" for _ in SENTENCE.finditer(ast.get_docstring(node) or ""))


@pytest.mark.parametrize("room", [*ROOMS, "diagnosis", "effects", "vision"])
def test_public_docstrings_name_errors_under_raises(room: str) -> None:
    files = (ROOT / room).rglob("*.py")
    found = {str(file.relative_to(ROOT)): names for file in files if (names := list(in_sentences(file.read_text())))}
    assert found == {}


def test_an_error_in_a_sentence_is_found() -> None:
    assert list(in_sentences('def run():\n    """Run. Raise RunError if it falls."""')) == ["line 1: run"]
    assert list(in_sentences('def run():\n    """Raise RunError if it falls."""')) == []


def riddles(source: str) -> Iterator[str]:
    """Yield the phrases of `RIDDLES` in docstrings and in comments inside functions, and docstrings that ask."""
    functions: list[range] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            functions.append(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text, line = " ".join((ast.get_docstring(node) or "").split()), getattr(node, "lineno", 1)
            yield from (f"line {line}: {found[0]}" for found in RIDDLES.finditer(text))
            yield from (f"line {line}: {found[0]}" for found in [QUESTIONS.match(text)] if found)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and any(token.start[0] in lines for lines in functions):
            yield from (f"line {token.start[0]}: {found[0]}" for found in RIDDLES.finditer(token.string))


@pytest.mark.parametrize("room", [*ROOMS, "benchmarks", "diagnosis", "effects", "vision"])
def test_docstrings_and_comments_are_no_riddles(room: str) -> None:
    files = (ROOT / room).rglob("*.py")
    found = {str(file.relative_to(ROOT)): words for file in files if (words := list(riddles(file.read_text("utf-8"))))}
    assert found == {}


def test_a_riddle_is_found() -> None:
    across_lines = 'def run():\n    """Return the answers after so\n    many pairs."""'
    assert list(riddles(across_lines)) == ["line 1: after so many"]
    assert list(riddles('"""What a run is."""')) == ["line 1: What"]
    assert list(riddles("def run():\n    pass  # linear, as they have it")) == ["line 2: as they have it"]
    assert list(riddles('def run():\n    """Return True for so many that they fill a page."""')) == []
