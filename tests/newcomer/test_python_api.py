"""The page of the Python API has every public name."""

from __future__ import annotations

from pathlib import Path

import kbmaps

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "python_api.md").read_text("utf-8")


def test_page_has_every_public_name_of_kbmaps() -> None:
    names = {line.removeprefix("::: kbmaps.") for line in PAGE.splitlines() if line.startswith("::: kbmaps.")}
    assert names == {name for name in kbmaps.__all__ if not name.startswith("_")}
