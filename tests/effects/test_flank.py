"""Backlash that rests on one flank, payloads that springs reveal, friction that lags."""

from __future__ import annotations

import numpy as np
import pytest
from effect_arms import arm, sized, walk

from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.effects.motion import flanks

MOTION = walk()
JOINT = "elbow"


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm(tmp_path_factory.mktemp("arm"))


def test_flank_changes_when_load_exceeds_friction() -> None:
    torque = np.array([0.1, -0.1, 2.0, -0.5, -2.0, 0.5, 2.0])
    np.testing.assert_array_equal(flanks(torque, 1.0), [1, 1, 1, 1, -1, -1, 1])
    np.testing.assert_array_equal(flanks(torque, 0.0), np.sign(torque))


def test_a_flank_is_carried_on_row_by_row() -> None:
    torque = np.random.default_rng(0).normal(size=50)
    whole, side, one_by_one = flanks(torque, 0.8), 0.0, []
    for value in torque:
        side = float(flanks(np.array([value]), 0.8, side)[0])
        one_by_one.append(side)
    np.testing.assert_array_equal(one_by_one, whole)


def test_gravity_backlash_turns_joint_by_half_its_width(robot) -> None:
    play = Simulation(robot, (Effect.at(robot, "gravity_backlash", JOINT, values=[0.02, 0.0]),))
    run, k = play.run(MOTION), robot.joints.index(JOINT)
    torque = Simulation(robot).run(MOTION).torques[:, k]
    np.testing.assert_allclose(run.q[:, k] - MOTION.q[:, k], 0.01 * np.sign(torque), atol=1e-15)


def test_payload_loads_springs_like_a_urdf_mass(tmp_path) -> None:
    robot = arm(tmp_path)
    spring = Effect.at(robot, "joint_compliance", JOINT, values=[0.003])
    payload = Effect.at(robot, "payload", values=[0.4, 0.4 * 0.03, 0.0, 0.4 * 0.02])
    loaded = Simulation(robot, (spring, payload)).positions(MOTION)
    urdf = tmp_path / "everything.urdf"
    urdf.write_text(urdf.read_text().replace('value="0.4"', 'value="0.8"'))  # the hand, with its centre at 0.03 0 0.02
    heavier = type(robot).load(robot.file)
    spring = Effect.at(heavier, "joint_compliance", JOINT, values=[0.003])
    np.testing.assert_allclose(loaded, Simulation(heavier, (spring,)).positions(MOTION), rtol=0, atol=1e-12)


def test_a_payload_without_springs_changes_nothing(robot) -> None:
    simulation = Simulation(robot, (sized(robot, ("payload", None, None), 1.0),))
    np.testing.assert_array_equal(simulation.positions(MOTION), Simulation(robot).positions(MOTION))


def test_friction_lag_saturates_after_a_long_move(robot) -> None:
    q = np.zeros((400, len(robot.joints)))
    q[:, 0] = np.concatenate([np.linspace(0.0, 1.0, 200), np.linspace(1.0, 0.0, 200)])
    effect = Effect.at(robot, "hysteresis", robot.joints[0], values=[0.01, 0.05])
    lag = q[:, 0] - Simulation(robot, (effect,)).unloaded(Motion(q, None, np.zeros(400, np.int64)))[:, 0]
    np.testing.assert_allclose(lag[:200], 0.01, atol=1e-12)
    back = 1.0 - q[200:, 0]
    np.testing.assert_allclose(lag[200:], 0.01 * (2.0 * np.exp(-back / 0.05) - 1.0), atol=1e-12)


def test_friction_is_independent_of_rows_along_the_path(robot) -> None:
    effect = Effect.at(robot, "hysteresis", robot.joints[0], values=[0.01, 0.05])
    ends = []
    for rows in (2, 50):
        way = np.concatenate([np.linspace(0.0, 1.0, 9), np.linspace(1.0, 0.96, rows)[1:]])
        q = np.zeros((len(way), len(robot.joints)))
        q[:, 0] = way
        ends.append(Simulation(robot, (effect,)).unloaded(Motion(q, None, np.zeros(len(way), np.int64)))[-1, 0])
    assert ends[0] == pytest.approx(ends[1], abs=1e-14)
