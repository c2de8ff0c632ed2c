"""Rectified images against ground truth, and the check of a calibration that no longer holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from board_renderer import Photographer, Printed, Taken, webcams
from scipy.spatial.transform import Rotation
from shown_board import BOARD, SIZE, Eyes, corner_views, known_rig

from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.records import StereoFrame
from bodyschema.vision.board import BoardDetector, Corners
from bodyschema.vision.calibration.calibrate import CalibrationRequest, calibrate
from bodyschema.vision.calibration.check import check
from bodyschema.vision.calibration.view import View
from bodyschema.vision.rig.rectified import Rectification, RectifiedCamera
from bodyschema.vision.rig.stereo_rig import CalibrationError, StereoRig, triangulated


@pytest.mark.parametrize("fisheye", [False, True], ids=["pinhole", "fisheye"])
def test_rectified_images_match_pinholes_in_stated_frame(fisheye) -> None:
    rng = np.random.default_rng(6)
    truth = webcams(rng, fisheye=fisheye)
    rig = known_rig(truth)
    photographer = Photographer(truth, Printed(square_m=0.04), Taken(), rng)
    R = Rotation.from_euler("xyz", [0.2, -0.3, 0.1]).as_matrix()
    pose = R, np.array([0.02, 0.0, 0.5]) - R @ np.array([0.16, 0.12, 0.0])
    with RectifiedCamera(Eyes([photographer.pair(*pose)]), rig) as camera:
        frame = camera.read(0.1)
    corners = (4 / 3 * BOARD.corners_m) @ R.T + pose[1]
    expected = camera.calibration.project(corners @ Rectification(rig).R_rectified_left.T)
    for image, px in ((frame.left, expected[:, :2]), (frame.right, expected[:, 2:])):
        found = BoardDetector(replace(BOARD, square_m=0.04)).find(image)
        assert isinstance(found, Corners)
        errors = found.px - px[found.numbers]
        assert np.sqrt(np.mean(errors**2)) < 0.15
        assert np.abs(errors.mean(axis=0)).max() < 0.04


@pytest.mark.parametrize("fisheye", [False, True], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 2))])
def test_every_pixel_of_a_rectified_image_was_seen(fisheye, seed) -> None:
    truth = webcams(np.random.default_rng(seed), fisheye=fisheye)
    white = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    with RectifiedCamera(Eyes([StereoFrame(0.0, white, white)]), known_rig(truth)) as camera:
        frame = camera.read(0.1)
    assert min(frame.left.min(), frame.right.min()) == 255


def test_rectified_points_and_triangulation_agree() -> None:
    truth = webcams(np.random.default_rng(6))
    rig = known_rig(truth)
    x = np.random.default_rng(0).uniform([-0.1, -0.1, 0.4], [0.15, 0.1, 1.0], (20, 3))
    left, right = truth.left.image(x), truth.right.image(x @ truth.R.T + truth.t_m)
    np.testing.assert_allclose(triangulated(rig, left, right), x, atol=1e-9)
    rectification = Rectification(rig)
    expected = rectification.calibration.project(x @ rectification.R_rectified_left.T)
    np.testing.assert_allclose(rectification.points(left, 0), expected[:, :2], atol=1e-6)
    np.testing.assert_allclose(rectification.points(right, 1), expected[:, 2:], atol=1e-6)


def test_rectified_frame_is_rotated_little_from_left_camera() -> None:
    truth = webcams(np.random.default_rng(6))
    R = Rectification(known_rig(truth)).R_rectified_left
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert Rotation.from_matrix(R).magnitude() < np.radians(8)


def test_uncalibrated_cameras_are_refused_and_closed() -> None:
    black = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    rig = known_rig(webcams(np.random.default_rng(6)))
    eyes = Eyes([StereoFrame(0.0, black, black)], ("A1", "C3"))
    with pytest.raises(CalibrationError, match="this is the calibration of another pair"), RectifiedCamera(eyes, rig):
        pass
    assert not eyes.is_open
    small = Eyes([StereoFrame(0.0, black[::2, ::2], black[::2, ::2])])
    with pytest.raises(CalibrationError, match="give images of 320x240"), RectifiedCamera(small, rig):
        pass


def test_image_of_another_size_is_a_source_error() -> None:
    black = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    eyes = Eyes([StereoFrame(0.0, black, black[::2])])
    camera = RectifiedCamera(eyes, known_rig(webcams(np.random.default_rng(6))))
    with camera, pytest.raises(SourceError, match="an image of 640x240, calibrated was 640x480"):
        camera.read(0.1)


# --- check


@pytest.fixture(scope="module")
def calibrated() -> tuple[StereoRig, View]:
    rng = np.random.default_rng(21)
    views = corner_views(webcams(rng), rng, 13)
    asked = CalibrationRequest(SIZE, ("A1", "B2"), "2026", model="pinhole")
    return calibrate(views[:-1], BOARD, asked).rig, views[-1]


def test_valid_calibration_passes_the_check(calibrated) -> None:
    found = check(*calibrated, BOARD)
    assert found.holds
    assert abs(found.rows_px) < 4 * found.rows_sigma_px
    assert abs(found.square_m - 0.030) < 4 * found.square_sigma_m


@pytest.mark.parametrize(
    ("axis", "said"),
    [(0, "turned up or down by 0.3"), (1, "turned inwards or outwards"), (2, "about its line of sight by 0.3")],
)
def test_a_bumped_camera_is_noticed(calibrated, axis, said) -> None:
    rig, view = calibrated
    bumped = rig.vector.copy()
    bumped[-6 + axis] += np.radians(0.3)
    found = check(rig.with_vector(bumped), view, BOARD)
    assert any(said in text for text in found.wrong), found


def test_another_board_than_was_calibrated_with_is_noticed(calibrated) -> None:
    assert "a square of 29.1 mm is measured as 30.0" in check(*calibrated, replace(BOARD, square_m=0.0291)).wrong[0]


def test_too_few_visible_corners_are_refused(calibrated) -> None:
    rig, view = calibrated
    with pytest.raises(CalibrationError, match="both eyes see 0 corners"):
        check(rig, replace(view, right=None), BOARD)


def test_cameras_without_common_view_report_their_angle() -> None:
    rig = known_rig(webcams(np.random.default_rng(6)))
    apart = replace(rig, rotation_rad=np.array([0.0, np.radians(70.0), 0.0]))
    with pytest.raises(CalibrationError, match=r"share almost no view: their lines of sight are 70° apart"):
        _ = Rectification(apart).calibration


def test_a_lens_that_folds_over_is_named() -> None:
    rig = known_rig(webcams(np.random.default_rng(6)))
    folded = replace(rig, left=replace(rig.left, distortion=(-1.2, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(CalibrationError, match="the pinhole lens model folds over within the image"):
        _ = Rectification(folded).calibration
