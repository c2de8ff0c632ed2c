"""A camera on the flange that sees a marker fixed in the world: the same chain, read from its other end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyschema.calibration.rigid_chain import Calibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.toml_file import read_toml

DESK_ARM = Path(__file__).parents[2] / "examples" / "desk_arm" / "robot.toml"
SIGMA = np.diag([0.05e-3, 0.05e-3, 0.5e-3])


def wrist_camera() -> RobotDescription:
    tables, text = read_toml(DESK_ARM)
    robot = tables["robot"] | {"joints": tables["robot"]["joints"][::-1], "marker_link": "base_link"}
    camera = {"parent_link": "gripper", "pose_known": False}
    return RobotDescription.from_tables({"robot": robot, "camera": camera}, text, DESK_ARM)


def recorded(robot: RobotDescription, T_gripper_camera: FloatArray, marker: FloatArray) -> Recording:
    rng = np.random.default_rng(5)
    q = rng.uniform(robot.lower, robot.upper, (60, len(robot.joints)))
    poses = robot.with_placement(T_gripper_camera, marker).chain.poses(q)
    x = poses[:, :3, 3] + rng.standard_normal((60, 3)) @ SIGMA
    turn = Rotation.from_matrix(poses[:, :3, :3]) * Rotation.from_rotvec([0.3, -0.2, 1.0])
    cov = np.broadcast_to(SIGMA @ SIGMA, (60, 3, 3))
    return Recording(joints=robot.joints, q=q, x=x, cov=cov, orientation=turn.as_quat())


@pytest.fixture(scope="module")
def found() -> tuple[FloatArray, Calibration]:
    """Return the camera's pose on the gripper and the calibration from 60 views of the nominal arm."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.2, 1.0, -0.4]).as_matrix(), (0.03, -0.04, 0.06)
    robot = wrist_camera()
    recording = recorded(robot, T, np.array([0.5, 0.2, 0.1]))
    return T, Calibration.of(robot, recording, sigma_m=None, zeros_rad=1e-6)


def test_flange_camera_pose_is_recovered_without_initial_guess(found) -> None:
    T, calibration = found
    pose = calibration.figures.geometry.T_parent_camera
    assert np.linalg.norm(pose[:3, 3] - T[:3, 3]) < 1e-3
    assert Rotation.from_matrix(pose[:3, :3].T @ T[:3, :3]).magnitude() < np.radians(0.1)


def test_its_intervals_hold_it(found) -> None:
    T, calibration = found
    figures = calibration.figures
    truth = np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_euler("xyz")])
    assert (np.abs(figures.values[:6] - truth) < 1.5 * figures.half_widths[:6]).all()


def test_a_wrong_tag_size_stays_within_the_intervals() -> None:
    T = np.eye(4)
    T[:3, 3] = 0.03, -0.04, 0.06
    robot = wrist_camera()
    recording = recorded(robot, T, np.array([0.5, 0.2, 0.1]))
    grown = replace(recording, x=1.01 * recording.x)

    def worst(common: Callable[[FloatArray], FloatArray] | None) -> float:
        found = Calibration.of(robot, grown, sigma_m=None, zeros_rad=1e-6, trusted="urdf", common=common).figures
        return float((np.abs(found.values[:3] - T[:3, 3]) / found.half_widths[:3]).max())

    assert worst(None) > 1.5
    assert worst(lambda x: 0.01 * x[:, :, None]) < 1.0
