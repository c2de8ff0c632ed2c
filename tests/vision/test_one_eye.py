"""One camera alone: the marker's pose from one image, and its ambiguity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_renderer import SMALL, Look
from board_renderer import TrueRig, webcams
from numpy.typing import ArrayLike
from scenes import Ball, reason, sigmas_off, stage
from scipy.spatial.transform import Rotation
from shown_board import BOARD, SIZE, corner_views
from tag_renderer import Sheet, photograph

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss, Reason, StereoFrame
from bodyschema.vision.calibration.calibrate import Calibrated, CalibrationRequest, calibrate
from bodyschema.vision.calibration.guidance import Coverage
from bodyschema.vision.calibration.view import ONE_EYE
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.rig.rig_file import read_rig, write_rig
from bodyschema.vision.rig.stereo_rig import OneEyeRig, OtherCameras
from bodyschema.vision.tags.body import TagBody
from bodyschema.vision.tags.config import ClusterConfig, PlacedTag, TagConfig
from bodyschema.vision.tags.tracker import TagTracker
from bodyschema.vision.tracked_camera import MarkerTracker
from bodyschema.vision.trackers import tracker_of

SIDE_M = 0.03
ONE: StereoCalibration = replace(SMALL, baseline_m=0.0)
TAG = VisionConfig(marker="tag", tag=TagConfig(side_m=SIDE_M))
BALL = VisionConfig(radius_m=0.02)
FACING = np.diag([1.0, -1.0, -1.0])


def tilted(degrees: float, about: ArrayLike = (1.0, 0.3, 0.0)) -> FloatArray:
    axis = np.asarray(about, dtype=np.float64) / np.linalg.norm(about)
    return Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix() @ FACING


def seen(*sheets: Sheet, t: float = 0.0, noise: float = 1.0, seed: int = 0) -> StereoFrame:
    look = Look(wall=0.4, samples=6, noise_sd=noise)
    return replace(photograph(sheets, SMALL, look, np.random.default_rng(seed), t=t), right=None)


def at(rotation: FloatArray, x: ArrayLike, id: int = 0) -> Sheet:
    return Sheet(id, rotation, np.asarray(x, dtype=np.float64), SIDE_M)


def turned_off(fix: MarkerFix, rotation: FloatArray) -> FloatArray:
    """Return the rotation error of the fix (3,) [rad]."""
    assert fix.R is not None
    return (Rotation.from_quat(fix.R) * Rotation.from_matrix(rotation).inv()).as_rotvec()


def fixed(tracker: MarkerTracker, frame: StereoFrame) -> MarkerFix:
    found = tracker.track(frame)
    assert isinstance(found, MarkerFix), found
    return found


@pytest.mark.parametrize("degrees", [-40.0, -20.0, 20.0, 40.0])
def test_a_tag_is_where_one_image_shows_it(degrees) -> None:
    truth, x = tilted(degrees), np.array([0.03, -0.02, 0.35])
    fix = fixed(tracker_of(ONE, TAG), seen(at(truth, x)))
    assert (fix.x - x) @ np.linalg.solve(fix.cov, fix.x - x) < 16.0
    assert np.linalg.norm(turned_off(fix, truth)) < np.radians(1.5)
    assert fix.centres_px is None


def test_single_eye_depth_sigma_exceeds_lateral_sigma_fivefold() -> None:
    across, _, depth = np.sqrt(np.diag(fixed(tracker_of(ONE, TAG), seen(at(tilted(30.0), [0.0, 0.0, 0.35]))).cov))
    assert depth > 5.0 * across


def film_of_a_small_tag_that_turns_to_the_camera() -> tuple[FloatArray, list[StereoFrame]]:
    """Return the final orientation of a small tag that turns to the camera, and the frames."""
    turns = [tilted(float(degrees)) for degrees in np.linspace(25.0, 7.0, 10)]
    frames = [seen(at(turn, [0.0, 0.0, 0.65]), t=0.03 * k, noise=10.0, seed=k) for k, turn in enumerate(turns)]
    return turns[-1], frames


def test_small_tag_with_two_possible_tilts_is_ambiguous() -> None:
    _, frames = film_of_a_small_tag_that_turns_to_the_camera()
    found = tracker_of(ONE, TAG).track(frames[-1])
    assert isinstance(found, MarkerMiss)
    assert found.reason is Reason.AMBIGUOUS


def test_motion_resolves_the_tilt_ambiguity() -> None:
    turn, frames = film_of_a_small_tag_that_turns_to_the_camera()
    tracker = tracker_of(ONE, TAG)
    fix = [fixed(tracker, frame) for frame in frames][-1]
    assert np.linalg.norm(turned_off(fix, turn)) < np.radians(6.0)


def test_oppositely_tilted_pose_never_becomes_a_fix() -> None:
    rng, fixes = np.random.default_rng(20261124), 0
    for k in range(12):
        truth = tilted(float(rng.uniform(0.0, 25.0)), rng.standard_normal(3) * [1.0, 1.0, 0.0])
        found = tracker_of(ONE, TAG).track(seen(at(truth, [0.0, 0.0, 0.6]), noise=2.0, seed=k))
        if isinstance(found, MarkerFix):
            assert found.cov_R is not None
            off, fixes = turned_off(found, truth), fixes + 1
            assert off @ np.linalg.solve(found.cov_R, off) < 36.0
    assert fixes


def test_flat_cluster_pose_is_recovered_from_one_image() -> None:
    plate = ClusterConfig(tags=tuple(PlacedTag(id=k, xyz=(0.04 * (k - 0.5), 0.0, 0.0)) for k in range(2)))
    tracker = TagTracker(ONE, TagBody.cluster(plate, TAG.tag), TAG.tag)
    truth, x = tilted(-25.0), np.array([0.0, 0.01, 0.4])
    fix = fixed(tracker, seen(*(at(truth, x + truth @ np.array(tag.xyz), tag.id) for tag in plate.tags)))
    assert (fix.x - x) @ np.linalg.solve(fix.cov, fix.x - x) < 16.0
    assert np.linalg.norm(turned_off(fix, truth)) < np.radians(1.0)


def test_stereo_frames_are_refused_by_image_count() -> None:
    with pytest.raises(SourceError, match=r"2 images for each instant, but the calibration is of 1.*\[camera\] eyes"):
        tracker_of(ONE, TAG).track(photograph([at(FACING, [0, 0, 0.4])], SMALL, Look(), np.random.default_rng(0)))


def test_ball_direction_is_sharp_depth_follows_size_sigma() -> None:
    ball = Ball((0.03, -0.02, 0.4))
    fix = fixed(tracker_of(ONE, BALL), replace(stage(ball), right=None))
    sight = fix.x / np.linalg.norm(fix.x)
    depth, across = np.sqrt(sight @ fix.cov @ sight), np.sqrt(np.linalg.eigvalsh(fix.cov)[:2].max())
    assert sigmas_off(fix, ball) < 4.0
    assert depth == pytest.approx(0.03 * 0.4, rel=0.1)
    assert across < 1e-4


def test_two_balls_are_ambiguous() -> None:
    frame = stage(Ball((-0.05, 0.0, 0.4)), Ball((0.06, 0.02, 0.45)))
    assert reason(tracker_of(ONE, BALL).track(replace(frame, right=None))) is Reason.AMBIGUOUS


def test_image_without_ball_has_no_marker() -> None:
    assert reason(tracker_of(ONE, BALL).track(replace(stage(), right=None))) is Reason.NO_MARKER


@pytest.fixture(scope="module")
def calibrated() -> tuple[TrueRig, Calibrated]:
    """Return one camera of a random pair, and its calibration from 20 views."""
    rng = np.random.default_rng(31)
    rig = webcams(rng)
    views = [replace(view, right=None) for view in corner_views(rig, rng)]
    return rig, calibrate(views, BOARD, CalibrationRequest(SIZE, ("A1",), "2026-01-01T00:00:00Z", model="pinhole"))


def test_one_camera_is_calibrated_within_its_intervals(calibrated) -> None:
    rig, found = calibrated
    truth = [*rig.left.focal_px, *rig.left.principal_point_px, *rig.left.distortion]
    assert np.abs((found.rig.vector - truth) / found.rig.sigma).max() < 4.0
    assert found.rig.sigma[0] < 1.0


def test_one_eye_calibration_file_round_trips(calibrated, tmp_path) -> None:
    _, found = calibrated
    write_rig(found.rig, tmp_path / "cameras.toml")
    read = read_rig(tmp_path / "cameras.toml")
    assert isinstance(read, OneEyeRig)
    assert read.serials == ("A1",)
    assert np.allclose(read.vector, found.rig.vector)
    assert np.allclose(read.covariance, found.rig.covariance, rtol=1e-4, atol=1e-12)


def test_rectified_it_is_the_same_camera_without_distortion(calibrated) -> None:
    rig, found = calibrated
    rectification = Rectification(found.rig)
    x = np.array([[0.05, -0.1, 0.8], [-0.1, 0.02, 0.7]])
    assert not rectification.calibration.is_stereo
    assert np.abs(rectification.points(rig.left.image(x), 0) - rectification.calibration.project(x)[:, :2]).max() < 1.5


def test_another_camera_than_the_calibrated_one_is_refused(calibrated) -> None:
    rig = calibrated[1].rig
    rig.require(SIZE, ("A1",))
    for size, serials, said in ((SIZE, ("B2",), "the camera is B2"), (SIZE, ("A1", "B2"), "two look")):
        with pytest.raises(OtherCameras, match=said):
            rig.require(size, serials)


def test_missing_views_are_requested_for_one_image() -> None:
    missing = Coverage.of([], BOARD, SIZE, ONE_EYE).missing()
    assert "bring the board to the upper left of the image" in missing
    assert "tilt the board's right edge away from the camera, by 30°" in missing
