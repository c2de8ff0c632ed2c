"""A test that is skipped says how to run it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from skip_remedies import with_remedy

TESTS = Path(__file__).parents[1]


def reasons(source: str) -> list[str]:
    """Return the literal texts of all calls that skip."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    skipping = [call for call in calls if getattr(call.func, "attr", "") in ("skip", "skipif")]
    spoken = [[*call.args, *(word.value for word in call.keywords if word.arg == "reason")][-1] for call in skipping]
    return [ast.unparse(text) for text in spoken if isinstance(text, ast.Constant | ast.JoinedStr)]


def test_skip_reasons_say_how_to_run() -> None:
    unhelpful = [
        (file.name, reason)
        for file in TESTS.rglob("*.py")
        if re.search(r"\bskip(if)?\(", source := file.read_text(encoding="utf-8"))
        for reason in reasons(source)
        if "to run it: " not in reason
    ]
    assert unhelpful == []


@pytest.mark.parametrize(("package", "extra"), [("pybullet", "sim"), ("httpx", "dev")])
def test_missing_packages_name_their_extra(package: str, extra: str) -> None:
    place = ("file.py", 3, f"Skipped: could not import '{package}': No module named '{package}'")
    shown = with_remedy(pytest.CollectReport("file.py", "skipped", place, None))
    assert shown.longrepr == ("file.py", 3, f"no {package}; to run it: pip install -e '.[{extra}]'")
