from __future__ import annotations

import re
from pathlib import Path

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "simulation.md").read_text(encoding="utf-8")


def block(language):
    return re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[1]


def test_the_pages_example_runs():
    names = {}
    exec(block("python"), names)
    assert names["frame"].t >= names["reading"].t > 0
    assert names["changed_at"] >= names["frame"].t
