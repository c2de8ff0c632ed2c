"""Errors that all fixes share, against positions through a calibration that is off."""

from __future__ import annotations

import numpy as np
import pytest
from board_renderer import webcams
from scipy.spatial.transform import Rotation
from shown_board import SIZE, true_vector

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.pose import PoseEstimator, Sighting, turn_jacobian
from bodyschema.vision.rig.common_error import CommonError
from bodyschema.vision.rig.lens import Lens
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.rig.stereo_rig import CalibrationProvenance, OneEyeRig, Rig, StereoRig, split, triangulated
from bodyschema.vision.tags.body import TAG_CORNERS

MADE = CalibrationProvenance("", "", 20, 0, 0.0, 0.0, 0.0)
SIDE_M = 0.02
X = np.array([[0.0, 0.0, 0.5], [0.12, -0.06, 0.6], [-0.1, 0.1, 0.4], [0.15, 0.1, 0.7]])
TILTS = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.arange(8) * np.pi / 4.0])
FACING = Rotation.from_rotvec([np.pi, 0.0, 0.0]).as_matrix()


def one_eye(vector: FloatArray, covariance: FloatArray) -> OneEyeRig:
    return OneEyeRig(Lens.from_vector("pinhole", vector), SIZE, ("",), covariance, MADE)


def two_eyes(vector: FloatArray, covariance: FloatArray) -> StereoRig:
    return StereoRig(*split("pinhole", vector), SIZE, ("", ""), covariance, MADE)


def beyond_turn(errors: FloatArray) -> FloatArray:
    """Return errors (n, 3) at X without their best-fitting turn of the frame."""
    rows = turn_jacobian(X).reshape(-1, 3)
    return errors - (rows @ np.linalg.lstsq(rows, errors.ravel())[0]).reshape(-1, 3)


def predicted(rig: Rig) -> FloatArray:
    return beyond_turn(CommonError(rig).errors(X).sum(axis=2))


VECTOR = np.array([600.0, 610.0, 318.0, 243.0, 0.05, -0.1, 1e-3, -5e-4, 0.0])


@pytest.mark.parametrize("parameter", [0, 2, 4, 6])
def test_one_eye_moves_small_tags_as_predicted(parameter: int) -> None:
    off = np.zeros(9)
    off[parameter] = 1e-3 * (VECTOR[0] if parameter < 4 else 1.0)
    believed, true = one_eye(VECTOR, np.diag(off**2 + 1e-24)), Lens.from_vector("pinhole", VECTOR + off)
    rectification, errors = Rectification(believed), []
    for axis in TILTS:
        R = Rotation.from_rotvec(np.radians(45.0) * axis).as_matrix() @ FACING
        for x in X:
            px = rectification.points(true.project(x + SIDE_M * TAG_CORNERS @ R.T), 0)
            sighting = Sighting(SIDE_M * TAG_CORNERS, px, np.eye(8), right=False)
            pose = PoseEstimator(rectification.calibration, [sighting]).refine(R, x)
            assert pose is not None
            errors.append(pose.x - x)
    mean = beyond_turn(np.reshape(errors, (len(TILTS), *X.shape)).mean(axis=0))
    apart = min(np.abs(mean - sign * predicted(believed)).max() for sign in (1, -1))
    assert apart < 0.1 * np.abs(mean).max() + 1e-6


@pytest.mark.parametrize("parameter", [0, 4, 9, 19, 21])
def test_two_eyes_move_points_as_predicted(parameter: int) -> None:
    vector = true_vector(webcams(np.random.default_rng(3)))
    off = np.zeros(len(vector))
    off[parameter] = 1e-3 * max(abs(vector[parameter]), 0.1)
    believed, true = two_eyes(vector, np.diag(off**2 + 1e-24)), two_eyes(vector + off, np.eye(len(vector)))
    own = X @ Rectification(believed).R_rectified_left
    right = own @ true.R_right_left.T + true.translation_m
    measured = triangulated(believed, true.left.project(own), true.right.project(right))
    errors = beyond_turn((measured - own) @ Rectification(believed).R_rectified_left.T)
    apart = min(np.abs(errors - sign * predicted(believed)).max() for sign in (1, -1))
    assert apart < 0.1 * np.abs(errors).max() + 1e-6


def test_the_size_of_a_tag_scales_all_distances() -> None:
    sure = one_eye(VECTOR, 1e-12 * np.eye(9))
    assert np.allclose(np.sqrt(CommonError(sure, 0.01).variance(X)), 0.01 * np.abs(X), atol=1e-6)


@pytest.mark.parametrize(
    "rig",
    [one_eye(VECTOR, 1e-4 * np.eye(9)), two_eyes(true_vector(webcams(np.random.default_rng(3))), 1e-4 * np.eye(24))],
    ids=["one eye", "two eyes"],
)
def test_variance_is_finite_at_extreme_positions(rig: Rig) -> None:
    x = np.array([[0.0, 0.0, -1.0], [5.0, 0.0, 0.1], [0.0, 0.0, 0.0]])
    assert np.isfinite(CommonError(rig, 0.01).variance(x)).all()
