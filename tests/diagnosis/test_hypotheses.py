"""Hypotheses that a recording cannot test are reported and not tested."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from planted_cases import BASE, ELBOW, SHOULDER, desk_arm, motion_of, observed, surveyed_arm, walk

from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.search.hypotheses import Hypotheses, has_simpler_name
from bodyschema.effects import EFFECT_TYPES, Effect, Motion, Simulation
from bodyschema.robot.description import RobotDescription

STEREO = """focal_px = 600.0                # from the stereo calibration
principal_point_px = [319.5, 239.5]
baseline_m = 0.20
image_size_px = [640, 480]
"""
HELD = {'hold = "torque_free"': 'hold = "held"'}


def asked_of(robot: RobotDescription, motion: Motion | None = None, **asked) -> Hypotheses:
    observations = observed(robot, walk(robot, 1) if motion is None else motion, (), 1)
    return Hypotheses.of(Simulation(robot), observations, **asked)


def names(hypotheses: Hypotheses) -> set[str]:
    return {effect.name for effect in hypotheses.effects}


def test_robot_without_masses_is_tested_for_joint_compliance() -> None:
    found = asked_of(desk_arm(HELD))
    assert "joint_compliance" in names(found)
    assert "payload" not in names(found)
    assert any("states no masses" in sentence for sentence in found.limitations)


def test_hand_supported_arm_is_not_tested_for_compliance() -> None:
    found = asked_of(desk_arm())
    assert "joint_compliance" not in names(found)
    assert [s for s in found.limitations if "torque_free" in s]
    assert not [s for s in found.limitations if "masses" in s]


def test_untimed_recording_is_not_tested_for_timed_effects() -> None:
    robot = desk_arm()
    timed, untimed = walk(robot, 1), dataclasses.replace(walk(robot, 1), t=None)
    assert names(asked_of(robot, timed)) - names(asked_of(robot, untimed)) == {
        k.name for k in EFFECT_TYPES.values() if k.needs_times
    }
    assert any("no times" in sentence for sentence in asked_of(robot, untimed).limitations)
    assert not any("no times" in sentence for sentence in asked_of(robot, timed).limitations)


def test_unmoved_joint_is_in_no_hypothesis() -> None:
    robot = desk_arm()
    q = walk(robot, 1).q.copy()
    q[:, robot.joints.index(ELBOW)] = 0.4
    found = asked_of(robot, motion_of(q))
    assert not [effect for effect in found.effects if ELBOW in (effect.where, effect.source)]
    assert [effect for effect in found.effects if effect.where == SHOULDER]
    assert f"{ELBOW} never moved: nothing can be said of it." in found.limitations


def test_uncalibrated_stereo_camera_is_not_tested_for_lenses() -> None:
    found = asked_of(desk_arm({STEREO: ""}))
    assert names(asked_of(desk_arm())) - names(found) == {
        kind.name for kind in EFFECT_TYPES.values() if kind.needs_stereo
    }
    assert any("no stereo calibration" in sentence for sentence in found.limitations)


def test_always_fitted_parameters_are_no_hypotheses() -> None:
    free = {"camera_pose", "tool_offset"}
    assert not free & names(asked_of(desk_arm()))
    assert free <= names(asked_of(surveyed_arm()))


def test_every_effect_is_tested_at_every_joint_once() -> None:
    robot = surveyed_arm()
    found = asked_of(robot)
    keys = [effect.key for effect in found.effects]
    assert len(set(keys)) == len(keys)
    d = len(robot.joints)
    for name in names(found):
        kind = EFFECT_TYPES[name]
        places = 1 if not kind.at_joint else d * (d - 1) if kind.takes_source else d
        assert sum(key[0] == name for key in keys) == places
    assert names(found) == {kind.name for kind in EFFECT_TYPES.values() if not kind.needs_weight}


def test_only_requested_effects_are_tested() -> None:
    robot = desk_arm()
    assert names(asked_of(robot, only=("backlash", "joint_scale"))) == {"backlash", "joint_scale"}
    assert "backlash" not in names(asked_of(robot, without=("backlash",)))


@pytest.mark.parametrize("rows", [3, 19])
def test_fewer_than_20_rows_test_nothing(rows) -> None:
    robot = desk_arm()
    full = observed(robot, walk(robot, 1), (), 1)
    motion = Motion(full.motion.q[:rows], np.arange(rows) / 4.0, np.zeros(rows, np.int64))
    few = Observations(motion, full.x[:rows], full.stated[:rows], full.rounding[:rows])
    assert Hypotheses.of(Simulation(robot), few).effects == ()


def test_first_link_error_is_simpler_as_camera_pose() -> None:
    robot = surveyed_arm()
    links = [Effect.at(robot, "link_geometry", joint) for joint in (BASE, ELBOW)]
    asked = [Effect.at(robot, "camera_pose"), *links]
    assert [has_simpler_name(one, asked, Simulation(robot)) for one in asked] == [False, True, False]
    assert not has_simpler_name(links[0], links, Simulation(robot))
