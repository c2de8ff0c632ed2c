"""Names of tests are short claims."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parents[1]
MOST_WORDS = 8


def long_names(source: str) -> Iterator[str]:
    """Yield the names of tests of more than `MOST_WORDS` words, the possessive `s` left out."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            words = [word for word in node.name.split("_")[1:] if word not in {"", "s"}]
            if len(words) > MOST_WORDS:
                yield node.name


def test_names_of_tests_have_at_most_eight_words() -> None:
    found = {str(file.relative_to(TESTS)): list(long_names(file.read_text("utf-8"))) for file in TESTS.rglob("*.py")}
    assert {file: names for file, names in found.items() if names} == {}


def test_ninth_word_is_counted() -> None:
    assert list(long_names("def test_a_b_c_d_e_f_g_h():\n    pass")) == []
    assert list(long_names("def test_a_b_c_d_e_f_g_h_i():\n    pass")) == ["test_a_b_c_d_e_f_g_h_i"]
