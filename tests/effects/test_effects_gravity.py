from __future__ import annotations

import numpy as np
import pytest
from effect_arms import ALL, arm
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.effects import GravityLoad
from bodyschema.effects.gravity import GRAVITY_M_S2
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend import ErrorConfig, SimConfig
from bodyschema.sim_backend.bullet import Body
from bodyschema.sim_backend.physics_urdf import physics_urdf
from bodyschema.sim_backend.truth import TrueRobot

NO_ERRORS = ErrorConfig(
    joint_offset_rad=0, link_length_m=0, link_axis_rad=0, camera_position_m=0, camera_rotation_rad=0, tool_m=0
)


TWO_RODS = """<robot name="arm"><link name="base"/><link name="upper"/><link name="fore"/>
<joint name="lift" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""
HELD = """[robot]
name = "arm"
urdf = "arm.urdf"
joints = ["lift", "elbow"]
marker_link = "fore"
marker_xyz = [0.2, 0.0, 0.0]
hold = "held"
[camera]
parent_link = "base"
"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def body(robot):
    truth = TrueRobot.draw(robot, SimConfig(errors=NO_ERRORS))
    with Body(physics_urdf(truth), robot.joints, gravity=GRAVITY_M_S2) as body:
        yield body


@given(st.lists(st.floats(-2.0, 2.0), min_size=len(ALL), max_size=len(ALL)).map(np.array))
def test_gravity_torques_are_the_negatives_of_pybullet_torques(robot, body, q) -> None:
    torques = GravityLoad(robot).torques(q[None])[0]
    np.testing.assert_allclose(torques, -body.gravity_torques(q), rtol=0, atol=1e-6)


def test_massless_links_are_weighed_as_rods_between_joints(tmp_path) -> None:
    (tmp_path / "arm.urdf").write_text(TWO_RODS)
    (tmp_path / "robot.toml").write_text(HELD)
    load = GravityLoad(RobotDescription.load(tmp_path / "robot.toml"))
    assert not load.known
    stretched = GRAVITY_M_S2 * np.array([0.5**2 / 2, 0.2**2 / 2])
    torques = load.torques(np.array([[0.0, 0.0], [0.0, np.pi / 2], [np.pi / 2, 0.0]]))
    np.testing.assert_allclose(torques[0], stretched)
    np.testing.assert_allclose(torques[1], [GRAVITY_M_S2 * (0.3**2 / 2 + 0.3 * 0.2), 0.0], atol=1e-12)
    np.testing.assert_allclose(torques[2], 0.0, atol=1e-12)
