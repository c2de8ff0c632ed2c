"""The base installation has no extras: all functions that need neither simulator nor cameras work without them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from two_processes import running, status_when, write_robot

from bodyschema.cli.main import MODULES
from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.interfaces.extras import install_command

ROOT = Path(__file__).parents[2]
# As if they were not installed, wherever they are.
GUARD = """
import sys

class Without:
    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("pybullet", "pybullet_data", "matplotlib", "cv2"):
            return None
        return self.finder.find_spec(name, path, target)

sys.meta_path[:] = map(Without, sys.meta_path)
"""


@pytest.fixture
def guarded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder whose sitecustomize keeps every Python that is started from importing the simulator."""
    folder = tmp_path / "guard"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(GUARD)
    path = os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), *filter(None, [path])]))
    return folder


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_the_guard_refuses_the_simulator(guarded: Path) -> None:
    assert "ModuleNotFoundError: No module named 'pybullet'" in run("import pybullet").stderr


def test_a_camera_command_names_the_extra(guarded: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bodyschema", "calibrate", "cameras", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stderr) == (
        1,
        f"bodyschema: this needs OpenCV, which is not installed. Type: {install_command('cameras')}\n",
    )


def test_every_command_but_the_simulator_s_can_be_loaded(guarded: Path) -> None:
    done = run(f"import importlib\nfor name in {sorted(MODULES.values())}: importlib.import_module(name)")
    assert done.stderr == ""


def test_sampler_and_learner_run(guarded: Path, tmp_path: Path, free_endpoint: Callable[[], str]) -> None:
    config = write_robot(tmp_path, free_endpoint, rows=120)
    with running(config, "sampler"), running(config, "learner"):
        assert status_when(config, "learner", LearnerStatus, lambda status: status.pairs == 120).health == []


def test_the_simulation_says_what_to_install(guarded: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "bodyschema", "run", "--sim", "--robot", ROOT / "examples" / "desk_arm" / "robot.toml"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, install_command("sim") in done.stderr) == (1, True)
