from __future__ import annotations

import numpy as np
import pytest
from guided_run import learning, shipped

from bodyschema.sim_backend import ErrorConfig, SimConfig, true_chain
from bodyschema.sim_backend.bullet import Body
from bodyschema.sim_backend.physics_urdf import physics_urdf
from bodyschema.sim_backend.truth import JointRoles, TrueRobot
from bodyschema.sim_backend.visibility import Gaze

NO_ERRORS = ErrorConfig(
    joint_offset_rad=0, link_length_m=0, link_axis_rad=0, camera_position_m=0, camera_rotation_rad=0, tool_m=0
)
ALL_ON_THE_WAY = (
    "neck_yaw", "neck_roll", "neck_pitch", "shoulder_flexion", "shoulder_abduction", "upperarm_rotation",
    "elbow_flexion", "forearm_rotation", "wrist_flexion", "wrist_abduction",
)  # fmt: skip


def postures(robot, count, seed):
    return np.random.default_rng(seed).uniform(robot.lower, robot.upper, (count, len(robot.joints)))


def test_the_same_seed_draws_the_same_truth():
    robot = shipped()
    q = postures(robot, 20, 0)
    first, second = (true_chain(robot, SimConfig(seed=5)).positions(q) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_another_seed_draws_another_truth():
    robot = shipped()
    q = postures(robot, 20, 0)
    apart = true_chain(robot, SimConfig(seed=5)).positions(q) - true_chain(robot, SimConfig(seed=6)).positions(q)
    assert np.linalg.norm(apart, axis=1).min() > 1e-3


def test_without_errors_the_truth_is_the_nominal_model():
    robot = shipped()
    q = postures(robot, 50, 1)
    truth = true_chain(robot, SimConfig(errors=NO_ERRORS))
    np.testing.assert_allclose(truth.positions(q), robot.chain.positions(q), atol=1e-12)


@pytest.mark.parametrize("joints", [ALL_ON_THE_WAY, ALL_ON_THE_WAY[3:8], ("neck_pitch", "elbow_flexion")])
def test_the_true_chain_agrees_with_pybullets_own_links(joints):
    robot, config = learning(joints), SimConfig(seed=3)
    truth, chain = TrueRobot.draw(robot, config), true_chain(robot, config)
    marker = truth.marker(np.array(robot.robot.marker_xyz))
    with Body(physics_urdf(truth), robot.joints) as body:
        for q in postures(robot, 30, 2):
            body.set_angles(q - truth.offsets)
            T_world_camera = body.link_pose("head") @ truth.T_parent_camera
            x_world = body.link_pose("hand") @ np.append(marker, 1.0)
            np.testing.assert_allclose(chain.positions(q), (np.linalg.inv(T_world_camera) @ x_world)[:3], atol=1e-6)


def test_tool_change_moves_true_marker_as_described():
    robot, config = shipped(), SimConfig(seed=4)
    q = postures(robot, 20, 3)
    before = true_chain(robot, config, (0.0, 0.0, -0.1)).positions(q)
    after = true_chain(robot, config, (0.15, 0.0, -0.3)).positions(q)
    np.testing.assert_allclose(np.linalg.norm(after - before, axis=1), 0.25, atol=1e-9)


def test_nominal_model_errs_by_60_to_80_mm():
    robot = shipped()
    assert robot.calibration is not None
    q = Gaze(robot, robot.calibration, JointRoles.of(robot).gaze).solve(postures(robot, 400, 4))
    x = robot.chain.positions(q)
    q, x = q[(x[:, 2] > 0.3) & (x[:, 2] < 0.8)], x[(x[:, 2] > 0.3) & (x[:, 2] < 0.8)]
    errors = [
        np.linalg.norm(true_chain(robot, SimConfig(seed=seed)).positions(q) - x, axis=1).mean() for seed in range(60)
    ]
    assert 0.060 < np.mean(errors) < 0.080


def test_camera_joints_gaze_and_marker_joints_are_guided():
    roles = JointRoles.of(shipped())
    assert (roles.gaze, roles.guided, roles.wrist, roles.elbow) == ((0, 1), (2, 3, 4, 5, 6), "hand", "elbow")
