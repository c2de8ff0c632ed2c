"""Poses to visit next: which, within which bounds, and in a form that other programs read."""

from __future__ import annotations

import csv
import functools
import json
import re
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from bodyschema.calibration.next_poses import NextPoses, allowed_poses
from bodyschema.calibration.rigid_chain import Calibration
from bodyschema.cli.main import command_line
from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription, link_poses
from kbmaps import ChainParameters, ChainTolerances

DESK_ARM = Path(__file__).parents[2] / "examples" / "desk_arm"
PAGE = Path(__file__).parents[2] / "docs" / "next_poses.md"
SIGMA_M = 5e-4
OFF = ChainTolerances(0.0, 0.0, zeros=0.03, tool=0.02, base_rotation=0.1, base_translation=0.05)


class Arm:
    """A desk arm with other offsets, camera and tool than nominal; pairs of a small part of its range."""

    def __init__(self, seed: int, pairs: int = 30) -> None:
        self.rng = np.random.default_rng(seed)
        self.robot = RobotDescription.load(DESK_ARM / "robot.toml")
        self.parameters = ChainParameters(self.robot.chain)
        self.change = self.parameters.standard_deviations(OFF) * self.rng.normal(size=self.parameters.size)
        self.q = self.rng.uniform(0.2 * self.robot.lower, 0.4 * self.robot.upper, (pairs, 4))
        self.x = self.measured(self.q)

    def measured(self, q: np.ndarray) -> np.ndarray:
        return self.parameters.positions(self.change, q) + SIGMA_M * self.rng.normal(size=(len(q), 3))

    def calibrated(self, further: np.ndarray | None = None) -> Calibration:
        q, x = self.q, self.x
        if further is not None:
            q, x = np.concatenate([q, further]), np.concatenate([x, self.measured(further)])
        recording = Recording(self.robot.joints, q, x)
        return Calibration.of(self.robot, recording, sigma_m=SIGMA_M, zeros_rad=0.05, trusted="links")


@functools.cache
def first_calibration(seed: int) -> Calibration:
    return Arm(seed).calibrated()


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(2, 9))])
def test_next_poses_tighten_intervals_more_than_random_ones(seed: int) -> None:
    arm, before = Arm(seed), first_calibration(seed)
    planned, random = NextPoses.of(before, 8).q, allowed_poses(before, arm.rng)[:8]
    now, chosen, drawn = (found.figures for found in (before, arm.calibrated(planned), arm.calibrated(random)))
    told = np.append(np.ones(9, dtype=bool), now.shown)
    widths = [np.log(figures.half_widths[told]).mean() for figures in (now, drawn, chosen)]
    assert widths[0] - widths[1] > 0.2
    assert widths[1] - widths[2] > 0.1


def test_next_poses_respect_limits_view_and_table() -> None:
    before = first_calibration(1)
    plan, robot = NextPoses.of(before, 12), before.robot
    assert (plan.q > robot.lower).all()
    assert (plan.q < robot.upper).all()
    pixels = robot.calibration.project(before.learner.predict(plan.q))
    assert (pixels > 0).all()
    assert (pixels < [640, 480, 640, 480]).all()
    lowest = [np.min([pose[:, 2, 3] for pose in link_poses(robot, q).values()]) for q in (plan.q, before.recording.q)]
    assert lowest[0] >= lowest[1]
    assert plan.expected_after_m < 0.7 * plan.expected_m


def test_too_few_poses_in_view_are_reported() -> None:
    before = first_calibration(1)
    blind = replace(before.robot, calibration=replace(before.robot.calibration, image_size_px=(2, 2)))
    with pytest.raises(RecordingError, match=r"only 0 poses are within the limits, in view"):
        NextPoses.of(replace(before, robot=blind), 5)


def test_poses_are_written_for_other_programs(tmp_path: Path) -> None:
    plan = NextPoses.of(first_calibration(1), 3)
    for ending in ("json", "csv"):
        plan.write(tmp_path / f"poses.{ending}", replace=False)
    found = json.loads((tmp_path / "poses.json").read_text())
    assert (found["schema"], found["joints"], found["units"]) == (1, list(plan.joints), ["rad"] * 4)
    names, *poses = csv.reader((tmp_path / "poses.csv").read_text().splitlines())
    assert names == list(plan.joints)
    assert np.array(poses, dtype=float) == pytest.approx(np.array(found["poses"]))
    with pytest.raises(RecordingError, match="there already"):
        plan.write(tmp_path / "poses.csv", replace=False)
    with pytest.raises(RecordingError, match=r"end in \.json, \.csv"):
        plan.write(tmp_path / "poses.txt", replace=False)


def test_calibrate_writes_poses_and_reports_their_gain(tmp_path: Path, capsys) -> None:
    arm = Arm(3)
    shutil.copytree(DESK_ARM, tmp_path, dirs_exist_ok=True)
    Recording(arm.robot.joints, arm.q, arm.x).write_csv(tmp_path / "pairs.csv")
    words = ["calibrate", str(tmp_path / "pairs.csv"), "--only", "offsets", "--next-poses", str(tmp_path / "poses.csv")]
    command_line("calibrate")([*words, "--poses", "3"], exit_on_error=False, result_action="return_value")
    assert re.search(r"3 poses written.*mm expected now, [\d.]+ mm with them", capsys.readouterr().out)
    assert len((tmp_path / "poses.csv").read_text().splitlines()) == 4


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, MagicMock]:
    """Return stand-ins of the modules that the page's scripts import, and go where poses.json is."""
    modules = (
        "moveit moveit.core moveit.core.robot_state moveit.planning lerobot lerobot.robots lerobot.robots.so_follower"
    )
    found = {name: MagicMock() for name in modules.split()}
    for name, module in found.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    monkeypatch.chdir(tmp_path)
    Path("poses.json").write_text('{"joints": ["a", "b"], "poses": [[0.1, -0.2], [0.3, 0.4]]}')
    return found


def script(of: str) -> str:
    return re.search(rf"## {of}\n.*?```python\n(.*?)```", PAGE.read_text(), re.DOTALL).group(1)


def test_the_moveit_script_plans_to_every_pose(foreign: dict[str, MagicMock]) -> None:
    moveit = foreign["moveit.planning"].MoveItPy.return_value
    exec(script("MoveIt"), {})
    assert foreign["moveit.core.robot_state"].RobotState.return_value.joint_positions == {"a": 0.3, "b": 0.4}
    assert moveit.execute.call_count == 2


def test_the_lerobot_script_moves_slowly_to_every_pose(foreign: dict[str, MagicMock]) -> None:
    arm = foreign["lerobot.robots.so_follower"].SO101Follower.return_value
    arm.get_observation.return_value = {"a.pos": 0.0, "b.pos": 0.0}
    exec(script("LeRobot"), {})
    sent = np.array([[call.args[0][name] for name in ("a.pos", "b.pos")] for call in arm.send_action.call_args_list])
    assert sent[99::100] == pytest.approx(np.degrees([[0.1, -0.2], [0.3, 0.4]]))
    assert np.abs(np.diff(sent, axis=0, prepend=0.0)).max() < 0.4
