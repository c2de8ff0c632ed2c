"""Child processes import nothing from the user's working directory."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hostile_folder import FIRST_PARTY, HostileFolder
from small_arm import write_small_arm

from bodyschema.interfaces.interpreter import module_command, safe_children
from bodyschema.robot.description import RobotDescription

ROOT = Path(__file__).parents[2]
LIMIT_S = 300.0
# Nothing listens on these ports.
SILENT = '[zenoh]\nsampler = "tcp/127.0.0.1:9"\nlearner = "tcp/127.0.0.1:10"\n'


def test_a_child_imports_nothing_from_the_current_folder(tmp_path: Path) -> None:
    hostile = HostileFolder(tmp_path)
    command = module_command("bodyschema", "--version")
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, cwd=tmp_path, check=True)
    assert (hostile.executed, done.stderr) == ([], "")


@pytest.mark.parametrize(
    ("command", "said"),
    [(["status"], "does not answer"), pytest.param(["diagnose", "pairs.csv"], "NOTHING FOUND", marks=pytest.mark.soak)],
)
def test_a_command_executes_nothing_of_the_current_folder(tmp_path: Path, command: list[str], said: str) -> None:
    here, robot = tmp_path / "hostile", tmp_path / "robot"
    here.mkdir()
    robot.mkdir()
    hostile, file = HostileFolder(here), write_small_arm(robot, SILENT)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 2))
    rows = np.column_stack([q, RobotDescription.load(file).chain.positions(q)])
    np.savetxt(here / "pairs.csv", rows, delimiter=",", header="waist,shoulder,x,y,z", comments="")
    whole = [Path(sys.executable).with_name("bodyschema"), *command, "--robot", file]
    done = subprocess.run(whole, capture_output=True, text=True, timeout=LIMIT_S, cwd=here, check=False)
    assert hostile.executed == []
    assert said in done.stdout


def test_a_users_own_vision_folder_is_not_ours(tmp_path: Path) -> None:
    for package in FIRST_PARTY - {"bodyschema"}:
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("raise ImportError(__file__)")
    command = [sys.executable, "-m", "bodyschema", "predict", "--robot", "no.toml", "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, cwd=tmp_path, check=False)
    assert done.stderr.startswith("bodyschema: no.toml: there is no such file")


def test_every_python_child_is_started_by_module_command() -> None:
    named = [file for package in FIRST_PARTY for file in (ROOT / package).rglob("*.py")]
    starting = {str(file.relative_to(ROOT)) for file in named if re.search(r"sys\.executable", file.read_text("utf-8"))}
    assert starting == {"interfaces/interpreter.py"}


def test_safe_children_hold_for_interpreters_of_others(tmp_path: Path) -> None:
    hostile, command = HostileFolder(tmp_path), [sys.executable, "-c", "import json"]
    with safe_children():
        subprocess.run(command, cwd=tmp_path, timeout=LIMIT_S, check=True)
    assert hostile.executed == []
    subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=LIMIT_S, check=False)
    assert hostile.executed == ["json.py.executed"]
