"""Installation without extras on every supported Python of this machine: no pybullet, and both processes learn."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from small_arm import JOINTS, write_small_arm

from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

ROOT = Path(__file__).parents[2]
LIMIT_S = 600.0
ROWS = 160
VERSIONS = ("3.11", "3.12", "3.13")


def python(version: str) -> Path:
    """Return the interpreter of this version, or skip the test if there is none."""
    found = shutil.which(f"python{version}")
    if found is None or subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode:
        pytest.skip(f"no Python {version}; to run it: pyenv install {version}")
    return Path(found)


def run(*command: object) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT_S, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def write_recording(robot: Path) -> Path:
    """Write a walk of 2° steps of an arm whose tool is 37 mm off nominal."""
    rng = np.random.default_rng(11)
    angle = np.cumsum(rng.normal(scale=0.2, size=ROWS))
    q = np.cumsum(np.deg2rad(2.0) * np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)
    x = RobotDescription.load(robot).chain.with_tool([0.02, -0.01, 0.03]).positions(q)
    file = robot.with_name("recording.csv")
    Recording(JOINTS, q, x + rng.normal(scale=1e-4, size=x.shape), t=np.arange(ROWS) * 0.1).write_csv(file)
    return file


@pytest.mark.soak
@pytest.mark.timeout(2 * LIMIT_S)
@pytest.mark.parametrize("version", VERSIONS)
def test_recording_is_learnt_without_extras(tmp_path: Path, version: str) -> None:
    recording = write_recording(write_small_arm(tmp_path))
    run(python(version), "-m", "venv", tmp_path / "venv")
    home = tmp_path / "venv" / "bin"
    run(home / "pip", "install", "--quiet", "--disable-pip-version-check", ROOT)
    assert "pybullet" not in run(home / "pip", "list").lower()
    said = run(home / "bodyschema", "replay", recording, "--robot", tmp_path / "robot.toml", "--json")
    assert re.search(r'"held_out', said), said
