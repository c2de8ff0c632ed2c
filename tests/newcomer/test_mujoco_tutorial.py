"""The commands of docs/mujoco_tutorial.md, typed as printed."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
import warm

pytest.importorskip("mujoco")

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "mujoco_tutorial.md").read_text(encoding="utf-8")
SHOWN = re.search(r"```text\n(.*?)```", PAGE, re.DOTALL)[1]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def figures(table: str) -> dict[str, list[float]]:
    """Return the numbers of each row, by the first two words of its name."""
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in table.splitlines() if line.count("│") > 3]
    return {" ".join(row[0].split()[:2]): [float(cell) for cell in row[1:] if cell] for row in rows}


def test_the_tutorial_ends_with_its_numbers(tmp_path: Path, monkeypatch, capfd) -> None:
    folder = Path(shutil.copytree(ROOT / "examples" / "desk_arm", tmp_path / "worn_arm"))
    shutil.copy(folder / "robot.toml", folder / "worn.toml")
    with (folder / "worn.toml").open("a") as file:
        file.write("\n" + blocks("toml")[0])
    poses, use = blocks("python")
    monkeypatch.chdir(folder)
    told = ""
    for command in "".join(blocks("console")[1:]).splitlines():
        program, *words = shlex.split(command)
        if program == "python":
            monkeypatch.setattr(sys, "argv", words)
            exec(poses, {})
            continue
        run = warm.run(
            "-m", "bodyschema", *words, cwd=folder, env={"OPENBLAS_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"}
        )
        assert run.returncode == 0, run.stderr
        told = run.stdout
    for name, numbers in figures(SHOWN).items():
        assert figures(told)[name] == pytest.approx(numbers, abs=0.002)
    assert "RMS [mm]" in told
    exec(use, {})
    assert "in the camera's frame" in capfd.readouterr().out
