"""Driver settings express the findings in the drivers' own units."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from bodyschema.cli.terminal.robot_export import write_snippets
from bodyschema.effects import Effect, Simulation
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.rpy import rotation_of

DESK_ARM = Path(__file__).parents[2] / "examples" / "desk_arm"
UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
TICK = 2.0 * np.pi / 4096.0


def snippets(robot: RobotDescription, tmp_path: Path, *effects: Effect) -> str:
    write_snippets(Simulation(robot, effects), tmp_path / "drivers.txt", "made by a test")
    return (tmp_path / "drivers.txt").read_text()


@pytest.mark.parametrize(("file", "homing"), [("servos.toml", -20), ("feetech.toml", 20)])
def test_servo_zeros_are_in_ticks(file, homing, tmp_path) -> None:
    robot = RobotDescription.load(DESK_ARM / file)
    # This joint counts against its servo.
    text = snippets(robot, tmp_path, Effect.at(robot, "joint_offset", "elbow_pitch", values=[20.2 * TICK]))
    [line] = [line for line in text.splitlines() if line.startswith("  elbow_pitch (ID 3")]
    assert "zero_ticks = 2068 in robot.toml" in line
    assert f"{homing:+d} on its Homing Offset" in line
    assert "0.018 deg left over" in line
    assert "LeRobot's homing_offset is the Homing Offset" in text


def test_ros2_control_gives_the_true_angle(tmp_path) -> None:
    robot = RobotDescription.load(DESK_ARM / "robot.toml")
    pairs = [("joint_offset", [0.03]), ("joint_scale", [0.02])]
    text = snippets(robot, tmp_path, *(Effect.at(robot, name, "elbow_pitch", values=value) for name, value in pairs))
    reduction, offset = (
        float(re.search(f"<{tag}>(.*)</{tag}>", text)[1]) for tag in ("mechanical_reduction", "offset")
    )
    assert 0.7 / reduction + offset == pytest.approx(0.7 * 1.02 + 0.03, abs=1e-12)


def test_ur_kinematics_has_links_and_zeros(tmp_path) -> None:
    links = "".join(f'<link name="link{k}"/>' for k in range(7))
    joints = "".join(
        f'<joint name="left_{name}_joint" type="revolute"><parent link="link{k}"/><child link="link{k + 1}"/>'
        '<origin xyz="0.1 0 0.2"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        for k, name in enumerate(UR_JOINTS)
    )
    (tmp_path / "ur.urdf").write_text(f'<robot name="ur">{links}{joints}</robot>')
    names = ", ".join(f'"left_{name}_joint"' for name in UR_JOINTS)
    head = f'[robot]\nname = "ur"\nurdf = "ur.urdf"\njoints = [{names}]\nmarker_link = "link6"\n'
    (tmp_path / "robot.toml").write_text(f'{head}[camera]\nparent_link = "link0"\n')
    robot = RobotDescription.load(tmp_path / "robot.toml")
    link = Effect.at(robot, "link_geometry", "left_elbow_joint", values=[0.001, 0, 0, 0, 0, 0])
    text = snippets(robot, tmp_path, link, Effect.at(robot, "joint_offset", "left_elbow_joint", values=[0.05]))
    block = text[text.index("  forearm:") :].splitlines()[1:7]
    x, y, z, *rpy = (float(line.split(":")[1]) for line in block)
    np.testing.assert_allclose([x, y, z], [0.101, 0.0, 0.2], atol=1e-12)
    np.testing.assert_allclose(rotation_of(np.array(rpy))[0], [np.cos(0.05), -np.sin(0.05), 0.0], atol=1e-12)
