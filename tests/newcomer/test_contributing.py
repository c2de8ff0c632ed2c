"""CONTRIBUTING.md leads to files and names that are there."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
QUOTED = sorted(set(re.findall(r"`([^`\n]+)`", PAGE)))
FILES = [name for name in QUOTED if re.fullmatch(r"[\w/]+\.py", name)]
MEMBERS = [name for name in QUOTED if re.fullmatch(r"[A-Z]\w+\.\w+", name)]


def tracked() -> list[str]:
    found = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return found.split()


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_it_names_is_there(name: str) -> None:
    assert [file for file in tracked() if f"/{file}".endswith(f"/{name}")]


@pytest.mark.parametrize("name", MEMBERS)
def test_a_method_that_it_names_is_there(name: str) -> None:
    owner, _, member = name.partition(".")
    texts = [(ROOT / file).read_text(encoding="utf-8") for file in tracked()]
    assert any(f"class {owner}" in text and re.search(rf"\b{member}\b", text) for text in texts)
