"""The pages of docs/reference are what the classes that they describe say."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
SPEC = importlib.util.spec_from_file_location("reference_pages", DOCS / "_reference.py")
assert SPEC is not None
assert SPEC.loader is not None
MODULE = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(MODULE)


@pytest.mark.parametrize("name", MODULE.PAGES)
def test_a_reference_page_is_up_to_date(name: str) -> None:
    text = MODULE.PAGES[name]()
    assert (DOCS / "reference" / name).read_text(encoding="utf-8") == text, "python docs/_reference.py"
    assert "|  |" not in text  # every key and field is explained
