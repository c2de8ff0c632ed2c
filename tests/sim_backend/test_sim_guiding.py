from __future__ import annotations

import numpy as np
import pytest
from guided_run import guide, learning, shipped, shipped_run, step_degrees

from bodyschema.sim_backend import SimConfig, true_chain
from bodyschema.sim_backend.bullet import Body
from bodyschema.sim_backend.config import CameraConfig, SimTag
from bodyschema.sim_backend.physics import TorqueFreeArm
from bodyschema.sim_backend.physics_urdf import physics_urdf
from bodyschema.sim_backend.truth import JointRoles, TrueRobot

SEEDS = (1, pytest.param(2, marks=pytest.mark.soak))


@pytest.fixture
def free_arm():
    """Yield the arm stretched out forward and not held, with a function that lets one second pass."""
    robot = shipped()
    truth, roles = TrueRobot.draw(robot, SimConfig()), JointRoles.of(robot)
    start = np.array([0.0, 0.3, 1.2, 0.3, 0.0, 0.4, 0.0])
    with Body(physics_urdf(truth), robot.joints) as body:

        def let_go(*, gravity_compensation):
            arm = TorqueFreeArm(body, roles, np.full(7, 0.1), gravity_compensation=gravity_compensation)
            body.set_angles(start)
            for _ in range(240):
                arm.step(start[:2])
            return body.angles() - start

        let_go.body, let_go.roles = body, roles
        yield let_go


def test_unheld_arm_falls(free_arm):
    moved = free_arm(gravity_compensation=False)
    assert moved[2] < -0.3


def test_gravity_compensation_holds_the_arm_in_place(free_arm):
    moved = free_arm(gravity_compensation=True)
    assert np.abs(moved[2:]).max() < 1e-3


def test_the_guided_joints_motors_apply_nothing(free_arm):
    free_arm(gravity_compensation=False)
    body = free_arm.body
    states = [body.bullet.getJointState(body.id, joint, physicsClientId=body.client) for joint in body.joints]
    assert [states[k][3] for k in free_arm.roles.guided] == [0.0] * 5


@pytest.mark.parametrize("seed", SEEDS)
def test_most_frames_are_one_to_three_degrees_apart(seed):
    steps = step_degrees(shipped_run(seed))
    assert ((steps >= 1.0) & (steps <= 3.0)).mean() > 0.9


@pytest.mark.parametrize("seed", SEEDS)
def test_ball_is_visible_in_four_of_five_frames(seed):
    assert shipped_run(seed).visible.mean() > 0.8


@pytest.mark.parametrize("seed", SEEDS)
def test_gaze_keeps_the_ball_near_image_centre(seed):
    run = shipped_run(seed)
    assert run.robot.calibration is not None
    pixels = run.robot.calibration.project(run.x)[:, :2]
    assert np.median(np.linalg.norm(pixels - [319.5, 239.5], axis=1)) < 150.0


@pytest.mark.parametrize("seed", SEEDS)
def test_guiding_covers_a_third_of_arm_joint_ranges(seed):
    run = shipped_run(seed)
    share = np.ptp(run.q, axis=0) / (run.robot.upper - run.robot.lower)
    assert share[2:].min() > 1 / 3


@pytest.mark.soak
@pytest.mark.parametrize("seed", SEEDS)
def test_ball_stays_visible_with_a_longer_tool(seed):
    run = guide(shipped(), SimConfig(seed=seed), 5.0, tool=(0.23, 0.0, -0.37), settle=1.0)
    assert run.visible.mean() > 0.8


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.soak
def test_single_tag_faces_the_eyes_in_most_frames(seed):
    robot = shipped()
    tag = SimTag(id=0, xyz=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0), side_m=0.06)
    config = SimConfig(seed=seed, camera=CameraConfig(tags=(tag,)))
    T = true_chain(robot, config).poses(guide(robot, config, 5.0).q)
    normals = T[:, :3, :3] @ TrueRobot.draw(robot, config).tool_turn[:, 2]
    to_eye = -T[:, :3, 3] / np.linalg.norm(T[:, :3, 3], axis=1, keepdims=True)
    oblique_deg = np.degrees(np.arccos(np.sum(normals * to_eye, axis=1)))
    assert (oblique_deg < 55.0).mean() > 0.9


@pytest.mark.parametrize(
    "joints",
    [
        ("neck_yaw", "neck_pitch", "shoulder_flexion", "upperarm_rotation", "elbow_flexion"),
        ("neck_yaw", "neck_pitch", "shoulder_flexion", "shoulder_abduction", "upperarm_rotation", "elbow_flexion"),
        (
            "neck_yaw", "neck_roll", "neck_pitch", "shoulder_flexion", "shoulder_abduction", "upperarm_rotation",
            "elbow_flexion", "forearm_rotation", "wrist_flexion", "wrist_abduction",
        ),
        ("shoulder_flexion", "shoulder_abduction", "upperarm_rotation", "elbow_flexion"),
    ],
    ids=len,
)  # fmt: skip
@pytest.mark.soak
def test_other_joint_selections_are_guided_in_view(joints):
    run = guide(learning(joints), SimConfig(seed=1), 5.0)
    steps = step_degrees(run)
    assert run.visible.mean() > 0.8
    assert ((steps >= 1.0) & (steps <= 3.0)).mean() > 0.8


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(1, 21))
def test_guiding_is_good_with_every_seed(seed):
    run = guide(shipped(), SimConfig(seed=seed), 60.0)
    steps = step_degrees(run)
    assert run.visible.mean() > 0.8
    assert ((steps >= 1.0) & (steps <= 3.0)).mean() > 0.9
