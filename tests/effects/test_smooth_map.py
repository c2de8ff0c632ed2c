"""A smooth function of the readings becomes a KB-Map: exactly for a sum of harmonics, otherwise approximately."""

from __future__ import annotations

import numpy as np
import pytest
from effect_arms import ALL, arm, walk

from bodyschema.effects import Effect, Motion, Simulation, load_simulation, place_map, smooth_map, write_extended
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

TOLERANCE_M = 1e-6


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> RobotDescription:
    return arm(tmp_path_factory.mktemp("arm"))


def elbows_error(robot: RobotDescription, q: FloatArray) -> FloatArray:
    """Return the marker's displacement for an elbow error that is a series in the lift's reading."""
    lift = q[:, ALL.index("shoulder_lift")]
    error = 0.01 * np.sin(lift) - 0.004 * np.cos(2.0 * lift) + 0.003 * np.sin(4.0 * lift)
    return Simulation(robot).run(Motion.still(q)).by_joint[:, :, ALL.index("elbow")] * error[:, None]


def test_joint_error_in_another_angle_meets_tolerance(robot) -> None:
    stored = smooth_map(robot, lambda q: elbows_error(robot, q), walk().q, TOLERANCE_M)
    q = walk(seed=7).q
    assert np.abs(stored.predict(q) - elbows_error(robot, q)).max() < 5.0 * TOLERANCE_M


def test_joints_that_do_not_affect_error_are_omitted(robot) -> None:
    def shift(q: FloatArray) -> FloatArray:
        return 0.01 * np.sin(2.0 * q[:, [ALL.index("elbow")]]) * np.array([1.0, 0.0, 2.0])

    stored = smooth_map(robot, shift, walk().q, TOLERANCE_M)
    assert set(stored.joints) - {"rail"} == {"elbow"}
    np.testing.assert_allclose(stored.predict(walk(3).q), shift(walk(3).q), atol=5.0 * TOLERANCE_M)


def test_function_of_marker_position_is_stored_over_coordinates(robot) -> None:
    def shift(x: FloatArray) -> FloatArray:
        return 0.02 * np.square(x[:, [2]]) * x

    x = robot.chain.positions(walk(rows=400).q)
    stored = place_map(robot, shift, x, TOLERANCE_M)
    q = walk(rows=400).q[::7]
    assert np.abs(stored.predict(q) - shift(robot.chain.positions(q))).max() < 20.0 * TOLERANCE_M


def test_constant_shift_is_stored(robot) -> None:
    stored = smooth_map(robot, lambda q: np.tile([0.01, -0.02, 0.03], (len(q), 1)), walk().q, TOLERANCE_M)
    np.testing.assert_allclose(stored.predict(walk(3).q), np.tile([0.01, -0.02, 0.03], (120, 1)), atol=1e-9)


def test_stored_map_with_factors_round_trips_through_file(robot, tmp_path) -> None:
    stored = smooth_map(robot, lambda q: elbows_error(robot, q), walk().q, TOLERANCE_M)
    written = Simulation(robot, (Effect.at(robot, "joint_offset", "elbow", values=[0.01]),), stored)
    read = load_simulation(write_extended(written, tmp_path / "out", "x"))
    np.testing.assert_array_equal(read.positions(walk()), written.positions(walk()))
