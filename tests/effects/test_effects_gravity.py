from __future__ import annotations

import numpy as np
import pytest
from effect_arms import ALL, LINKS, arm, walk
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.effects import GravityLoad
from bodyschema.effects.gravity import GRAVITY_M_S2
from bodyschema.sim_backend import ErrorConfig, SimConfig
from bodyschema.sim_backend.bullet import Body
from bodyschema.sim_backend.physics_urdf import physics_urdf
from bodyschema.sim_backend.truth import TrueRobot

NO_ERRORS = ErrorConfig(
    joint_offset_rad=0, link_length_m=0, link_axis_rad=0, camera_position_m=0, camera_rotation_rad=0, tool_m=0
)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def body(robot):
    truth = TrueRobot.draw(robot, SimConfig(errors=NO_ERRORS))
    with Body(physics_urdf(truth), robot.joints, gravity=GRAVITY_M_S2) as body:
        yield body


@given(st.lists(st.floats(-2.0, 2.0), min_size=len(ALL), max_size=len(ALL)).map(np.array))
def test_torques_are_those_that_pybullet_needs_to_hold_the_arm_turned_round(robot, body, q) -> None:
    torques = GravityLoad(robot).torques(q[None])[0]
    np.testing.assert_allclose(torques, -body.gravity_torques(q), rtol=0, atol=1e-6)


def test_an_arm_without_masses_has_no_known_load(tmp_path) -> None:
    robot = arm(tmp_path)
    file = tmp_path / "everything.urdf"
    text = file.read_text()
    for mass, _ in LINKS.values():
        text = text.replace(f'<mass value="{mass}"/>', '<mass value="0"/>')
    file.write_text(text)
    weightless = GravityLoad(type(robot).load(robot.file))
    assert not weightless.known
    assert not weightless.torques(walk().q).any()
