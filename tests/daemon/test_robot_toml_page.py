"""docs/reference/robot_toml.md is what the classes that read robot.toml say."""

from __future__ import annotations

import importlib.util
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def test_the_reference_of_robot_toml_is_up_to_date() -> None:
    spec = importlib.util.spec_from_file_location("robot_toml_page", DOCS / "_robot_toml.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = module.page()
    assert (DOCS / "reference" / "robot_toml.md").read_text(encoding="utf-8") == text, "python docs/_robot_toml.py"
    assert "|  |" not in text  # every key is explained
