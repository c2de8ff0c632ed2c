"""The numbered scripts in examples/ do as their texts say."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyschema.cli.main import app
from bodyschema.robot.description import RobotDescription

ROOT = Path(__file__).parents[2]
POSES = np.random.default_rng(7).uniform(-1.0, 1.0, (300, 4))
SCRIPTS = sorted((ROOT / "examples").glob("[0-9]_*.py"))


def main_of(number: int, *arguments: Path) -> Any:
    """Call the `main` of a script and return its result."""
    return runpy.run_path(str(SCRIPTS[number - 1]))["main"](*arguments)


def test_first_map_is_exact_on_full_circle(capsys) -> None:
    assert main_of(1) < 1e-9
    assert "learnt from 27 poses within ±60°: 81 numbers" in capsys.readouterr().out


def test_the_online_learner_gets_below_the_noise(capsys) -> None:
    errors = main_of(2)
    assert list(errors) == ["drawing", "10 samples", "100 samples", "1000 samples", "20 replays"]
    assert sorted(errors.values(), reverse=True) == list(errors.values())
    assert errors["20 replays"] < 10.0 < errors["100 samples"]
    assert "20 replays:" in capsys.readouterr().out


def test_new_tool_reaches_noise_after_thirty_pairs(capsys) -> None:
    errors = main_of(3)
    assert errors["second tool, no sample of it"] > 150.0
    assert errors["second tool, 30 samples"] < 5.0 < errors["drawing"]
    assert len(capsys.readouterr().out.splitlines()) == len(errors)


@pytest.fixture
def calibrated(tmp_path) -> dict[str, Any]:
    return main_of(4, tmp_path)


def test_thirty_pairs_calibrate_arm_with_report_table(calibrated, capsys) -> None:
    off = calibrated["learner"].predict(POSES) - calibrated["real"].positions(POSES)
    assert np.linalg.norm(off, axis=1).mean() < 0.002
    assert str(calibrated["report"]).count("±") == 9 + 4
    assert calibrated["report"].undetermined == ("base turn y", "base shift x", "joint 1 zero", "joint 4 zero")


def test_the_calibrated_arm_comes_within_two_millimetres(calibrated) -> None:
    assert calibrated["miss"] < 0.002


def test_what_was_kept_is_what_was_learnt(calibrated) -> None:
    np.testing.assert_array_equal(calibrated["again"].predict(POSES), calibrated["learner"].predict(POSES))


def test_the_written_urdf_is_the_learnt_arm(calibrated) -> None:
    robot = RobotDescription.load(calibrated["written"])
    np.testing.assert_allclose(robot.chain.positions(POSES), calibrated["learner"].predict(POSES), rtol=0, atol=1e-8)


def test_twenty_joints_are_learnt_from_150_pairs(capsys) -> None:
    errors = main_of(5)
    assert errors["5 mm of noise"] < 5.0 < 50.0 < errors["drawing"]
    assert errors["0 mm of noise"] < 1e-6
    assert "would have 10,460,353,203 numbers, the chain has 109" in capsys.readouterr().out


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_each_is_short(script: Path) -> None:
    assert len(script.read_text(encoding="utf-8").splitlines()) <= 60


def test_the_library_page_lists_them_all() -> None:
    page = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    assert re.findall(r"\(\.\./examples/([0-9]_\w+\.py)\)", page) == [script.name for script in SCRIPTS]


def test_tool_poses_calibrate_mounted_camera(tmp_path, capsys) -> None:
    """As docs/one_camera.md says, without a joint of the robot."""
    for file in (ROOT / "examples" / "tool_poses").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    rng = np.random.default_rng(4)
    places = rng.uniform([0.2, -0.3, 0.3], [0.7, 0.3, 0.6], (30, 3))
    angles = rng.uniform([2.64, -0.5, -2.0], [3.64, 0.5, 0.5], (30, 3))
    R_base_tool = Rotation.from_euler("xyz", angles)
    R_tool_camera, t_tool_camera = Rotation.from_euler("xyz", [0.03, 0.01, -1.58]), np.array([-0.017, 0.031, -0.011])
    on_tool = R_base_tool.inv().apply(np.array([0.4, -0.1, 0.0]) - places)
    seen = R_tool_camera.inv().apply(on_tool - t_tool_camera) + 5e-4 * rng.normal(size=(30, 3))
    names = [f"tool_{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    rows = np.hstack([places, angles, seen])
    np.savetxt(tmp_path / "poses.csv", rows, "%.9f", ",", header=",".join([*names, "x", "y", "z"]), comments="")
    words = ["calibrate", str(tmp_path / "poses.csv"), "--trust-urdf", "--json"]
    app(words, exit_on_error=False, result_action="return_value")
    found = json.loads(capsys.readouterr().out)
    off = [
        number["learnt"] - wanted for number, wanted in zip(found["camera_xyz_mm"], 1e3 * t_tool_camera, strict=True)
    ]
    assert found["camera_link"] == "tool"
    assert np.abs(off).max() < 1.0
