"""A vergence error is distinguished from a wrong scale if the data allow it, and left open otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_cases import SIGMA_M, measured, surveyed_arm, walk
from scipy.spatial.transform import Rotation

from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.diagnosis.unnamed.vergence import by_turn, correct, reported
from bodyschema.effects import Effect, Simulation
from bodyschema.interfaces.records import FloatArray

TURNS = st.lists(st.floats(-0.01, 0.01), min_size=3, max_size=3).map(np.array)
ROBOT = surveyed_arm()
ROWS = 200
assert ROBOT.calibration is not None
CALIBRATION = ROBOT.calibration


def points(seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform([-0.3, -0.3, 0.6], [0.3, 0.3, 1.2], size=(50, 3))


def triangulated(x: FloatArray, turn: FloatArray) -> FloatArray:
    """Triangulate pixels: each camera's own matrix, the rows averaged."""
    c = CALIBRATION
    K = np.array([[c.focal_px, 0.0, c.principal_point_px[0]], [0.0, c.focal_px, c.principal_point_px[1]], [0, 0, 1]])
    left = K @ x.T
    right = K @ Rotation.from_rotvec(turn).inv().as_matrix() @ (x - [c.baseline_m, 0.0, 0.0]).T
    (ul, vl), (ur, vr) = left[:2] / left[2], right[:2] / right[2]
    depth = c.focal_px * c.baseline_m / (ul - ur)
    pixels = np.stack([ul - K[0, 2], 0.5 * (vl + vr) - K[1, 2], np.full(len(x), c.focal_px)], axis=1)
    return pixels * (depth / c.focal_px)[:, None]


@given(TURNS)
def test_vergence_report_matches_pixel_triangulation(turn) -> None:
    np.testing.assert_allclose(reported(points(), CALIBRATION, turn), triangulated(points(), turn), atol=1e-12)


@given(TURNS)
def test_vergence_report_is_invertible(turn) -> None:
    np.testing.assert_allclose(correct(reported(points(), CALIBRATION, turn), CALIBRATION, turn), points(), atol=1e-6)


def test_derivatives_by_turns_are_those_of_small_turns() -> None:
    turn = np.array([2e-6, -1e-6, 3e-6])
    moved = reported(points(), CALIBRATION, turn) - points()
    np.testing.assert_allclose(by_turn(points(), CALIBRATION, np.eye(3)) @ turn, moved, atol=1e-9)


def found(x: FloatArray, seed: int) -> DiagnosisFile:
    noise = SIGMA_M * np.random.default_rng([seed, 1]).normal(size=x.shape)
    return conclusion(diagnose(measured(ROBOT, walk(ROBOT, seed, ROWS), x + noise), Simulation(ROBOT)))


def with_turned_eyes(vergence: float, seed: int) -> DiagnosisFile:
    right = Simulation(ROBOT).positions(walk(ROBOT, seed, ROWS))
    return found(reported(right, CALIBRATION, np.array([0.0, vergence, 0.0])), seed)


@pytest.mark.parametrize("vergence", [0.002, pytest.param(-0.005, marks=pytest.mark.soak)])
def test_vergence_is_unexplained_rather_than_scale(vergence) -> None:
    file = with_turned_eyes(vergence, 1)
    assert (file.verdict, file.causes) == ("unexplained", ())
    assert file.unexplained.what == ("the eyes are turned towards each other",)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.soak
def test_ambiguous_vergence_is_never_a_sure_scale(seed) -> None:
    file = with_turned_eyes(0.0002, seed)
    assert not any(cause.effect == "camera_scale" and cause.probability > 0.9 for cause in file.causes)


def test_camera_scale_is_not_mistaken_for_vergence() -> None:
    scale = Effect.at(ROBOT, "camera_scale", values=[0.004])
    file = found(Simulation(ROBOT, (scale,)).positions(walk(ROBOT, 1, ROWS)), 1)
    assert (file.verdict, [cause.effect for cause in file.causes]) == ("explained", ["camera_scale"])
