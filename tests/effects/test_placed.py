"""Parameters unknown in robot.toml are written to the file itself, and not to the effects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from effect_arms import STEREO, arm, walk

from bodyschema.effects import Effect, Simulation, load_simulation, place_map, write_extended
from bodyschema.robot.description import RobotDescription

POSE, SHIFT = [0.03, -0.02, 0.05, 0.2, -0.1, 0.3], [0.01, 0.02, -0.03]


def roughly_known(folder: Path, *flags: str) -> RobotDescription:
    robot = arm(folder, tables=STEREO + ("pose_known = false\n" if "pose" in flags else ""))
    if "marker" in flags:
        robot.file.write_text(robot.file.read_text().replace("hold =", "marker_known = false\nhold ="))
    return RobotDescription.load(robot.file)


def simulation(robot: RobotDescription) -> Simulation:
    wanted = {
        "camera_pose": POSE,
        "tool_offset": SHIFT,
        "camera_moved": [*POSE, 4.0],
        "tool_slip": [*SHIFT, 5.0],
        "camera_scale": [0.01],
    }
    effects = [Effect.at(robot, name, values=values) for name, values in wanted.items()]
    return Simulation(robot, (*effects, Effect.at(robot, "joint_compliance", "elbow", values=[0.002])))


@pytest.mark.parametrize("flags", [("pose",), ("marker",), ("pose", "marker")])
def test_the_written_simulation_measures_the_same(tmp_path, flags) -> None:
    before = simulation(roughly_known(tmp_path, *flags))
    after = load_simulation(write_extended(before, tmp_path / "out", "x"))
    np.testing.assert_allclose(after.positions(walk()), before.positions(walk()), rtol=0.0, atol=1e-9)


def test_unknown_pose_and_marker_are_stored_outside_effects(tmp_path) -> None:
    robot = roughly_known(tmp_path, "pose", "marker")
    after = load_simulation(write_extended(simulation(robot), tmp_path / "out", "x"))
    assert not {"camera_pose", "tool_offset"} & {effect.name for effect in after.effects}
    assert (after.robot.camera.pose_known, after.robot.robot.marker_known) == (False, False)
    np.testing.assert_allclose(after.robot.robot.marker_xyz, np.add(robot.robot.marker_xyz, SHIFT), atol=1e-12)


def test_known_camera_pose_stays_an_effect(tmp_path) -> None:
    after = load_simulation(write_extended(simulation(roughly_known(tmp_path, "marker")), tmp_path / "out", "x"))
    assert "camera_pose" in {effect.name for effect in after.effects}
    assert "tool_offset" not in {effect.name for effect in after.effects}


def test_place_map_keeps_its_original_marker_positions(tmp_path) -> None:
    robot = roughly_known(tmp_path, "pose", "marker")
    x = robot.chain.positions(walk().q)
    learnt = place_map(robot, lambda x: 0.1 * np.square(x), x, 1e-5)
    before = Simulation(robot, simulation(robot).effects, learnt)
    after = load_simulation(write_extended(before, tmp_path / "out", "x"))
    np.testing.assert_allclose(after.positions(walk()), before.positions(walk()), rtol=0.0, atol=1e-9)
