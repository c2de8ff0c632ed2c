"""The numbered scripts in examples/ do what their texts say."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted((ROOT / "examples").glob("[0-9]_*.py"))


def main_of(number: int) -> Any:
    """What the `main` of a script returns."""
    return runpy.run_path(str(SCRIPTS[number - 1]))["main"]()


def test_the_first_map_is_exact_on_the_whole_circle(capsys) -> None:
    assert main_of(1) < 1e-9
    assert "learnt from 27 poses within ±60°: 81 numbers" in capsys.readouterr().out


def test_the_online_learner_gets_below_the_noise(capsys) -> None:
    errors = main_of(2)
    assert list(errors) == ["drawing", "10 pairs", "100 pairs", "1000 pairs", "20 replays"]
    assert sorted(errors.values(), reverse=True) == list(errors.values())
    assert errors["20 replays"] < 10.0 < errors["100 pairs"]
    assert "20 replays:" in capsys.readouterr().out


def test_another_tool_is_known_to_the_noise_after_thirty_pairs(capsys) -> None:
    errors = main_of(3)
    assert errors["second tool, no pair of it"] > 150.0
    assert errors["second tool, 30 pairs"] < 5.0 < errors["drawing"]
    assert len(capsys.readouterr().out.splitlines()) == len(errors)


def test_thirty_pairs_find_the_zeros_inside_their_intervals(capsys) -> None:
    report, true_zeros, off = main_of(4)
    zeros = np.abs(np.degrees(report.zeros.value) - true_zeros) < np.degrees(report.zeros.half_width)
    assert (zeros.sum() >= 5, off < 0.002) == (True, True)
    assert capsys.readouterr().out.count("±") == len(true_zeros) + 1


def test_twenty_joints_are_learnt_from_150_pairs(capsys) -> None:
    errors = main_of(5)
    assert errors["5 mm of noise"] < 5.0 < 50.0 < errors["drawing"]
    assert errors["0 mm of noise"] < 1e-6
    assert "would have 10,460,353,203 numbers, the chain has 109" in capsys.readouterr().out


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_each_is_short(script: Path) -> None:
    assert len(script.read_text(encoding="utf-8").splitlines()) <= 60


def test_the_readme_lists_them_all() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"\(examples/([0-9]_\w+\.py)\)", readme) == [script.name for script in SCRIPTS]
