"""Remedies for a cause: following the instructions makes the simulation correct."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from walked import DESK_ARM

from bodyschema.diagnosis.report.numbers import number, numbers_of, percent, significant_numbers
from bodyschema.diagnosis.report.result import (
    Cause,
    DiagnosisFile,
    Errors,
    Gain,
    Indistinguishable,
    Interval,
    Pairs,
    Unexplained,
    Verdict,
)
from bodyschema.diagnosis.report.text import finding, remedies
from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

ERRORS = Errors(1.0, 1.0, 1.0, 1.0, 1.0)
SIX = {"x_m": 0.004, "y_m": -0.003, "z_m": 0.002, "rx_rad": 0.01, "ry_rad": -0.02, "rz_rad": 0.015}


@pytest.fixture
def robot(tmp_path: Path) -> RobotDescription:
    """Return the desk arm, in a folder of its own, with known camera and marker."""
    text = DESK_ARM.read_text().replace("_known = false", "_known = true")
    (tmp_path / "robot.toml").write_text(text)
    (tmp_path / "desk_arm.urdf").write_text((DESK_ARM.parent / "desk_arm.urdf").read_text())
    return RobotDescription.load(tmp_path / "robot.toml")


def cause(effect: Effect, **more) -> Cause:
    numbers = {p.name: Interval(v, (v, v)) for p, v in zip(effect.parameters, effect.values.tolist(), strict=True)}
    told = {"probability": 1.0, "rivals": ()} | more
    return Cause(
        effect.name, effect.where, effect.source, numbers, told["probability"], 100.0, 1.0, (), told["rivals"], ""
    )


def told(
    robot: RobotDescription,
    *causes: Cause,
    step: float = 0.0,
    torque: float | None = None,
    verdict: Verdict = "explained",
) -> list[str]:
    file = DiagnosisFile(
        verdict, "", Pairs(1, 1, 0), ERRORS, ERRORS, Gain(0.0, (0.0, 0.0)), causes, (), Unexplained(0.0, (), 1.0),
        (), (),
    )  # fmt: skip
    d = len(robot.joints)
    return remedies(file, robot, np.full(d, step), None if torque is None else np.full(d, torque))


def positions(robot: RobotDescription, *effects: Effect) -> FloatArray:
    q = np.random.default_rng(2).uniform(robot.lower, robot.upper, (50, len(robot.joints)))
    return Simulation(robot, effects).positions(Motion(q, None, np.zeros(50, np.int64)))


def edited(robot: RobotDescription, keys: str) -> RobotDescription:
    """Return the robot with lines of robot.toml changed, given as `xyz = [...], rpy = [...]`."""
    text = robot.file.read_text()
    for key, value in re.findall(r"(\w+) = (\[[^]]*\]|[0-9.]+)", keys):
        text, count = re.subn(rf"^{key} = (\[[^]]*\]|[0-9.]+)", f"{key} = {value}", text, flags=re.MULTILINE)
        assert count == 1
    tomllib.loads(text)
    robot.file.write_text(text)
    return RobotDescription.load(robot.file)


def test_an_offset_is_given_in_degrees_and_ticks(robot) -> None:
    effect = Effect.at(robot, "joint_offset", "elbow_pitch", values={"offset_rad": np.radians(0.52)})
    assert "Add +0.52° (+6 ticks of 4096 a turn)" in told(robot, cause(effect), step=2.0 * np.pi / 4096)[0]


def test_beside_what_is_unexplained_a_remedy_is_conditional(robot) -> None:
    effect = Effect.at(robot, "joint_coupling", "elbow_pitch", "base_yaw", values=[3e-4])
    (remedy,) = told(robot, cause(effect), verdict="unexplained")
    assert remedy.startswith("If it is joint elbow_pitch moving with joint base_yaw and not a part of what remains")


def test_laser_tracker_remedy_mentions_no_images(robot) -> None:
    outliers = Cause("outliers", None, None, {"share": Interval(0.006, (0.002, 0.01))}, 1.0, 0.0, 0.0, (), (), "")
    assert told(robot, outliers)[0].startswith("Look at the images of the 0.6 % of fixes")
    assert told(replace(robot, calibration=None), outliers, verdict="unexplained") == [
        "Look for what else was measured in 0.6 % of the fixes, or was in the way. They were left out here."
    ]


@pytest.mark.parametrize("step", [1e-4, np.radians(0.01)])
def test_decimals_of_a_file_are_no_ticks(robot, step) -> None:
    effect = Effect.at(robot, "joint_offset", "elbow_pitch", values={"offset_rad": np.radians(0.52)})
    assert "tick" not in told(robot, cause(effect), step=step)[0]


def test_remedy_without_known_ticks_mentions_no_ticks(robot) -> None:
    effect = Effect.at(robot, "joint_offset", "elbow_pitch", values={"offset_rad": 0.01})
    assert "tick" not in told(robot, cause(effect))[0]


@pytest.mark.parametrize("joint", ["shoulder_pitch", "elbow_pitch", "wrist_roll"])
def test_following_urdf_origin_remedy_corrects_the_positions(robot, joint) -> None:
    effect = Effect.at(robot, "link_geometry", joint, values=SIX)
    wanted = positions(robot, effect)
    found = re.search(r'xyz="([^"]*)" rpy="([^"]*)"', told(robot, cause(effect))[0])
    assert found is not None
    urdf = robot.tree.file
    begin, rest = urdf.read_text().split(f'<joint name="{joint}"')
    rest = re.sub(r"<origin [^>]*/>", f'<origin xyz="{found[1]}" rpy="{found[2]}"/>', rest, count=1)
    urdf.write_text(f'{begin}<joint name="{joint}"{rest}')
    np.testing.assert_allclose(positions(RobotDescription.load(robot.file)), wanted, atol=5e-6)


@pytest.mark.parametrize(
    ("name", "values"),
    [("camera_pose", SIX), ("tool_offset", {axis: SIX[axis] for axis in ("x_m", "y_m", "z_m")}),
     ("camera_scale", {"scale_error": 0.02}), ("camera_focal", {"focal_error": -0.01})],
)  # fmt: skip
def test_following_robot_toml_remedy_corrects_the_positions(robot, name, values) -> None:
    effect = Effect.at(robot, name, values=values)
    remedy = told(robot, cause(effect))[0]
    changed = edited(robot, remedy)
    calibration, nominal = changed.calibration, robot.calibration
    assert calibration is not None
    assert nominal is not None
    if name in ("camera_pose", "tool_offset"):
        np.testing.assert_allclose(positions(changed), positions(robot, effect), atol=5e-5)
        return
    # The true camera's pixels, triangulated with the calibration that is advised, are where the marker is.
    reported = positions(robot, effect)
    pixels = nominal.project(reported)
    depth = calibration.focal_px * calibration.baseline_m / (pixels[:, 0] - pixels[:, 2])
    np.testing.assert_allclose(depth, positions(robot)[:, 2], rtol=1e-5)


def test_camera_bump_is_relative_to_the_fitted_pose(robot) -> None:
    pose = Effect.at(robot, "camera_pose", values=SIX)
    bump = Effect.at(robot, "camera_moved", values={**SIX, "t0": -1.0})
    changed = edited(robot, told(robot, cause(pose), cause(bump))[1].split("is xyz")[1].join(["xyz", ""]))
    np.testing.assert_allclose(positions(changed), positions(robot, pose, bump), atol=5e-5)


def test_a_spring_tells_how_far_it_gives(robot) -> None:
    effect = Effect.at(robot, "joint_compliance", "shoulder_pitch", values=[np.radians(0.2)])
    assert "up to 0.4° here" in told(robot, cause(effect), torque=2.0)[0]


def test_reversed_joint_sign_is_named_as_such(robot) -> None:
    effect = Effect.at(robot, "joint_scale", "wrist_roll", values=[-2.0])
    assert "the other sign" in told(robot, cause(effect))[0]
    assert "counts the other way" in finding("joint_scale", "wrist_roll", None, {"scale_error": -2.0})


def test_remedy_of_uncertain_cause_states_its_rival_first(robot) -> None:
    effect = Effect.at(robot, "backlash", "elbow_pitch", values=[0.01])
    rival = Indistinguishable("settling", "elbow_pitch", None, "this_motion", 0.4)
    remedy = told(robot, cause(effect, probability=0.6, rivals=(rival,)))[0]
    assert remedy.startswith("If it is play of joint elbow_pitch and not joint elbow_pitch read before")


def test_numbers_have_the_digits_that_their_interval_has() -> None:
    shown = number("offset_rad", Interval(np.radians(0.5234), (np.radians(0.4934), np.radians(0.5534))))
    assert (shown.label, shown.value, shown.interval) == ("offset", "+0.523°", "± 0.030")


def test_asymmetric_interval_is_shown_by_its_ends() -> None:
    assert number("t0", Interval(40.0, (39.0, 44.0))).interval == "(39.0 … 44.0)"


def test_a_moment_without_times_is_a_row() -> None:
    assert number("t0", Interval(40.0, (39.0, 41.0)), timed=False).value == "row 40.0"


def test_undetermined_numbers_are_omitted(robot) -> None:
    effect = Effect.at(robot, "link_geometry", "elbow_pitch", values=SIX)
    known = cause(effect)
    known.parameters["y_m"] = Interval(0.0, (-0.3, 0.3))
    known.parameters["z_m"] = Interval(0.001, (-0.002, 0.004))
    labels = [n.label for n in significant_numbers(numbers_of(known, timed=True))]
    assert labels == ["shift in x", "turn about x", "turn about y", "turn about z"]


def test_no_probability_is_called_certain() -> None:
    assert (percent(1.0), percent(0.93), percent(0.0)) == ("> 99 %", "93 %", "< 1 %")
