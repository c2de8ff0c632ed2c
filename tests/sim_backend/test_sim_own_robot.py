from __future__ import annotations

import numpy as np
import pytest
from guided_run import described, guide, in_eye, step_degrees

from bodyschema.interfaces.errors import ConfigError
from bodyschema.sim_backend import SimConfig, SimWorld
from bodyschema.sim_backend.physics import Physics
from bodyschema.sim_backend.truth import JointRoles, TrueRobot

LIMIT_S = 500.0
# A carriage on a rail with a two-joint arm, no inertias given, and a camera on a mast.
URDF = """<robot name="carriage">
  <link name="base"/>
  <link name="carriage"><visual><geometry><box size="0.1 0.1 0.05"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0.1 0 0"/><geometry><box size="0.2 0.04 0.04"/></geometry></visual></link>
  <link name="fore"><visual><origin xyz="0.08 0 0"/><geometry><box size="0.16 0.03 0.03"/></geometry></visual></link>
  <joint name="rail" type="prismatic"><parent link="base"/><child link="carriage"/><axis xyz="0 1 0"/>
    <limit lower="-0.3" upper="0.3" effort="10" velocity="1"/></joint>
  <joint name="shoulder" type="revolute"><parent link="carriage"/><child link="upper"/><axis xyz="0 -1 0"/>
    <limit lower="-0.9" upper="0.9" effort="10" velocity="1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0.2 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-1.2" upper="1.2" effort="10" velocity="1"/></joint>
</robot>"""

TOML = """
[robot]
name = "carriage"
urdf = "robot.urdf"
joints = {joints}
marker_link = "{marker_link}"
marker_xyz = [0.2, 0.0, 0.0]
[camera]
parent_link = "{camera_link}"
xyz = {xyz}
rpy = {rpy}
focal_px = 500.0
principal_point_px = [319.5, 239.5]
baseline_m = 0.12
image_size_px = [640, 480]
"""

ON_A_MAST = TOML.format(
    joints='["rail", "shoulder", "elbow"]', marker_link="fore", camera_link="base",
    xyz=[1.3, 0.06, 0.1], rpy=[-1.5707963, 0.0, 1.5707963],
)  # fmt: skip
ON_THE_HAND = TOML.format(
    joints='["elbow", "shoulder", "rail"]', marker_link="base", camera_link="fore",
    xyz=[-0.6, 0.06, 0.0], rpy=[-1.5707963, 0.0, -1.5707963],
)  # fmt: skip


def test_base_camera_rail_robot_is_guided_in_view(tmp_path):
    run = guide(described(tmp_path, URDF, ON_A_MAST), SimConfig(seed=1), 6.0)
    steps = step_degrees(run)
    assert run.visible.mean() > 0.8
    assert ((steps >= 1.0) & (steps <= 3.0)).mean() > 0.8


@pytest.mark.parametrize("toml", [ON_A_MAST, ON_THE_HAND], ids=["camera on a mast", "camera on the hand"])
def test_true_chain_of_own_robot_matches_pybullet_links(tmp_path, toml):
    robot, config = described(tmp_path, URDF, toml), SimConfig(seed=2)
    assert robot.calibration is not None
    truth = TrueRobot.draw(robot, config)
    chain = truth.chain(np.array(robot.robot.marker_xyz))
    with Physics(truth, robot.calibration, config) as physics:
        for q in np.random.default_rng(0).uniform(robot.lower, robot.upper, (20, 3)):
            physics.body.set_angles(q - truth.offsets)
            np.testing.assert_allclose(chain.positions(q), in_eye(physics.scene()), atol=1e-6)


def test_camera_joints_are_guided_for_hand_camera(tmp_path):
    roles = JointRoles.of(described(tmp_path, URDF, ON_THE_HAND))
    assert (roles.gaze, roles.guided, roles.wrist) == ((), (2, 1, 0), "fore")


def test_hand_camera_robot_is_guided_in_view(tmp_path):
    run = guide(described(tmp_path, URDF, ON_THE_HAND), SimConfig(seed=1), 6.0)
    assert run.visible.mean() > 0.8


def test_such_a_robot_delivers_readings_and_frames(tmp_path):
    robot = described(tmp_path, URDF, ON_A_MAST)
    with SimWorld(robot, SimConfig()) as world, world.joints, world.camera:
        frame, reading = world.camera.read(LIMIT_S), world.joints.read(LIMIT_S)
    assert frame is not None
    assert reading is not None
    assert (frame.left.shape, reading.q.shape) == ((480, 640, 3), (3,))


def test_camera_never_seeing_the_marker_is_refused(tmp_path):
    looking_away = ON_A_MAST.replace("1.5707963, 0.0, 1.5707963", "1.5707963, 0.0, -1.5707963")
    robot = described(tmp_path, URDF, looking_away)
    with pytest.raises(ConfigError, match="hardly any posture"), SimWorld(robot, SimConfig()):
        pass
