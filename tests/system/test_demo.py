"""The demo as a newcomer runs it, but shorter."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import warm
from hostile_folder import HostileFolder

from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

pytest.importorskip("pybullet")

# The limit only ends a demo that would never end; on a busy machine it takes longer, and passes.
LIMIT_S = 400
FIRST, SECOND = 8, 4


@dataclass(frozen=True)
class Demo:
    folder: Path
    current: HostileFolder
    result: subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    folder, current = tmp_path_factory.mktemp("demo") / "out", HostileFolder(tmp_path_factory.mktemp("current"))
    command = [str(Path(sys.executable).with_name("bodyschema")), "demo", "--out", str(folder), "--seed", "3"]
    command += ["--pairs", str(FIRST), "--pairs-after", str(SECOND)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=LIMIT_S, cwd=current.path)
    return Demo(folder, current, done)


def test_the_demo_ends_well(demo: Demo) -> None:
    assert demo.result.returncode == 0, demo.result.stderr


def test_its_processes_execute_nothing_of_the_current_folder(demo: Demo) -> None:
    assert demo.current.executed == []


def test_the_demo_leaves_a_recording_with_every_pair(demo: Demo) -> None:
    with (demo.folder / "recording.csv").open(newline="") as stream:
        assert len(list(csv.DictReader(stream))) >= FIRST + SECOND


def test_first_tool_recording_ends_at_tool_change(demo: Demo) -> None:
    robot = RobotDescription.load(demo.folder / "robot.toml")
    both, first = (Recording.read(demo.folder / f"{name}.csv", robot.joints) for name in ("recording", "first_tool"))
    moved = np.linalg.norm(np.diff(both.x[len(first) - 3 : len(first) + 3], axis=0), axis=1)
    assert moved.argmax() == 2


def test_the_demo_plots_the_curve_it_measured(demo: Demo) -> None:
    with (demo.folder / "learning_curve.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) >= 2
    picture = ElementTree.parse(demo.folder / "learning_curve.svg").getroot()
    assert len(picture.findall(".//{*}polyline")) == 4


def test_the_learnt_model_beats_the_nominal_one(demo: Demo) -> None:
    with (demo.folder / "learning_curve.csv").open(newline="") as stream:
        last = list(csv.DictReader(stream))[-1]
    assert float(last["held_out_error_mm"]) < 0.7 * float(last["nominal_error_mm"])


def test_predictions_were_answered_all_the_while(demo: Demo) -> None:
    assert " 0 went unanswered" in demo.result.stdout


def test_without_a_terminal_the_demo_prints_plain_lines(demo: Demo) -> None:
    assert "\x1b" not in demo.result.stdout


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(5))
def test_demo_reaches_its_figures_with_honest_uncertainty(tmp_path: Path, seed: int) -> None:
    """Require 20 mm after 600 pairs, 30 mm 300 pairs after the tool change, and predicted errors within a factor 2."""
    command = [sys.executable, "-m", "bodyschema", "demo", "--out", str(tmp_path / "out"), "--seed", str(seed)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT_S)
    first, second = re.findall(r"│ +([\d.]+) mm │ +([\d.]+) mm │ +(\d+) % │", done.stdout)
    print(f"seed {seed}: {first}, {second}")
    for (error, claimed, covered), limit_mm in ((first, 20.0), (second, 30.0)):
        assert float(error) <= limit_mm
        assert 0.5 < float(claimed) / float(error) < 2.0
        assert 40.0 < float(covered) < 95.0


def test_demo_refuses_foreign_folder(tmp_path: Path) -> None:
    precious = tmp_path / "thesis.tex"
    precious.write_text("years of work")
    result = warm.run("-m", "bodyschema", "demo", "--out", tmp_path)
    assert result.returncode == 1
    assert "thesis.tex" in result.stderr
    assert precious.read_text() == "years of work"


@pytest.mark.soak
def test_the_demo_over_servos_learns_as_well(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bodyschema", "demo", "--bus", "dynamixel", "--out", str(tmp_path / "out")]
    command += ["--pairs", "30", "--pairs-after", "10", "--seed", "3"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 0, done.stderr
    assert "7 servos, torque verified off" in (tmp_path / "out" / "daemon.log").read_text()
    with (tmp_path / "out" / "first_tool.csv").open(newline="") as stream:
        changed_at = len(list(csv.DictReader(stream)))
    with (tmp_path / "out" / "learning_curve.csv").open(newline="") as stream:
        last = [row for row in csv.DictReader(stream) if int(row["pairs"]) <= changed_at][-1]
    assert int(last["pairs"]) >= 30
    assert float(last["held_out_error_mm"]) < 0.7 * float(last["nominal_error_mm"])


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(5))
def test_demo_over_servos_reaches_demo_figures(tmp_path: Path, seed: int) -> None:
    command = [sys.executable, "-m", "bodyschema", "demo", "--bus", "dynamixel", "--out", str(tmp_path / "out")]
    done = subprocess.run([*command, "--seed", str(seed)], check=True, capture_output=True, text=True, timeout=LIMIT_S)
    first, second = re.findall(r"│ +([\d.]+) mm │ +([\d.]+) mm │ +\d+ % │", done.stdout)
    print(f"seed {seed}: {first}, {second}")
    assert float(first[0]) <= 20.0
    assert float(second[0]) <= 30.0
    assert all(0.5 < float(claimed) / float(error) < 2.0 for error, claimed in (first, second))
    assert " 0 went unanswered" in done.stdout
