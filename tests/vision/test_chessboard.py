"""A plain chessboard as the marker: its pose, its one way up, and what is not taken for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from ball_renderer import SMALL, Look
from scipy.spatial.transform import Rotation
from tag_renderer import Card, Sheet, photograph

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss, Reason, StereoFrame
from bodyschema.vision.cameras.annotate import Annotator
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.pose import PoseEstimator, Sighting
from bodyschema.vision.tags.body import TagBody, bends
from bodyschema.vision.tags.config import ChessboardConfig
from bodyschema.vision.trackers import tracker_of

ONE: StereoCalibration = replace(SMALL, baseline_m=0.0)
EYES = {"one": ONE, "two": SMALL}
SQUARES, SIDE_M = (7, 4), 0.012
BOARD = VisionConfig(
    marker="chessboard", chessboard=ChessboardConfig(columns=SQUARES[0], rows=SQUARES[1], square_m=SIDE_M)
)
PLACE = np.array([0.03, 0.0, 0.45])


def facing(tilt_deg: float, spin_deg: float = 0.0, about: Sequence[float] = (1.0, 0.4, 0.0)) -> FloatArray:
    axis = np.array(about) / np.linalg.norm(about)
    spun = Rotation.from_euler("z", spin_deg, degrees=True).as_matrix()
    return Rotation.from_rotvec(np.radians(tilt_deg) * axis).as_matrix() @ np.diag([1.0, -1.0, -1.0]) @ spun


def shown(rotation: FloatArray, x: FloatArray = PLACE, squares: tuple[int, int] = SQUARES) -> Sheet:
    return Sheet(0, rotation, x, SIDE_M, margin=0.5, squares=squares)


def photographed(eyes: str, *things: Sheet | Card, seed: int = 0, t: float = 0.0, noise: float = 2.0) -> StereoFrame:
    frame = photograph(things, SMALL, Look(samples=5, noise_sd=noise), np.random.default_rng(seed), t=t)
    return frame if eyes == "two" else replace(frame, right=None)


def off(found: MarkerFix | MarkerMiss, rotation: FloatArray, x: FloatArray = PLACE) -> tuple[FloatArray, FloatArray]:
    """Return the error of a fix, place and turn (6,) [m, rad], and its claimed 1-sigma (6,)."""
    assert isinstance(found, MarkerFix), found
    assert found.R is not None
    assert found.cov_R is not None
    turn = (Rotation.from_quat(found.R) * Rotation.from_matrix(rotation).inv()).as_rotvec()
    sigma = np.sqrt(np.concatenate([np.diag(found.cov), np.diag(found.cov_R)]))
    return np.concatenate([found.x - x, turn]), sigma


@pytest.mark.parametrize("eyes", EYES)
def test_chessboard_is_where_its_corners_are(eyes) -> None:
    rotation = facing(30.0)
    error, sigma = off(tracker_of(EYES[eyes], BOARD).track(photographed(eyes, shown(rotation))), rotation)
    assert (np.abs(error) < 4.5 * sigma).all()
    assert (sigma[:3] < 5e-4).all()
    assert (sigma[3:] < np.radians(0.3)).all()


@pytest.mark.parametrize("eyes", EYES)
def test_chessboard_has_one_way_up(eyes) -> None:
    for k in range(8):
        rotation = facing(20.0, 45.0 * k + 7.0)
        error, sigma = off(tracker_of(EYES[eyes], BOARD).track(photographed(eyes, shown(rotation), seed=k)), rotation)
        assert (np.abs(error) < 5.0 * sigma).all(), k


@pytest.mark.soak
@pytest.mark.parametrize("eyes", EYES)
def test_chessboard_is_as_sure_as_it_claims(eyes) -> None:
    rng, within = np.random.default_rng(2), []
    for k in range(60):
        rotation = facing(float(rng.uniform(5.0, 50.0)), float(rng.uniform(0.0, 360.0)), (*rng.normal(size=2), 0.0))
        found = tracker_of(EYES[eyes], BOARD).track(photographed(eyes, shown(rotation), seed=k))
        if isinstance(found, MarkerFix):
            error, sigma = off(found, rotation)
            within.append(np.abs(error) < np.outer([1.0, 2.0], sigma))
    once, twice = 100.0 * np.mean(within, axis=(0, 2))
    assert len(within) >= 51  # from 45° on, squares of 16 px are too narrow for some
    assert 60.0 < once < 76.0
    assert twice > 90.0


def curled(eyes: str, curl: float, frames: int = 12) -> tuple[FloatArray, FloatArray]:
    """Return errors and claims (n, 6) of rendered boards that curl by `curl` [1/m] across their width."""
    columns = np.arange(1, SQUARES[0]) - 0.5 * SQUARES[0]
    raised = 0.5 * curl * float(np.square(SIDE_M * columns).mean())  # the plane nearest to the corners
    rng, found = np.random.default_rng(5), []
    for k in range(frames):
        rotation = facing(float(rng.uniform(15.0, 40.0)), float(rng.uniform(0.0, 360.0)), (*rng.normal(size=2), 0.0))
        frame = photographed(eyes, replace(shown(rotation), curl=curl), seed=k)
        found.append(off(tracker_of(EYES[eyes], BOARD).track(frame), rotation, PLACE + raised * rotation[:, 2]))
    errors, sigmas = zip(*found, strict=True)
    return np.array(errors), np.array(sigmas)


@pytest.mark.parametrize("eyes", EYES)
def test_curled_chessboard_sigma_stays_valid_and_small(eyes) -> None:
    errors, sigmas = curled(eyes, 4.0)
    assert np.sqrt(np.square(errors / sigmas).mean(axis=0)).max() < 1.6
    assert (np.median(sigmas, axis=0) < 2.0 * np.median(curled(eyes, 0.0)[1], axis=0)).all()


@pytest.mark.parametrize("eyes", EYES)
@pytest.mark.parametrize(
    "bent", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.5, 0.7, 0.5)], ids=["curled", "twisted", "askew"]
)
def test_bent_plate_pose_error_matches_its_covariance(eyes, bent) -> None:
    calibration, noise_px, rng = EYES[eyes], 0.03, np.random.default_rng(3)
    corners = TagBody.chessboard(ChessboardConfig(columns=8, rows=5, square_m=0.02)).corners[0]
    heights, off_flat, off_bent = bends(corners), [], []
    for _ in range(40):
        rotation = facing(float(rng.uniform(10.0, 45.0)), float(rng.uniform(0.0, 360.0)), (*rng.normal(size=2), 0.0))
        seen = corners + 0.0004 * np.outer(heights @ bent, [0.0, 0.0, 1.0])
        px = np.array([calibration.project(p) for p in seen @ rotation.T + PLACE]).reshape(-1, 2, 2)
        px += noise_px * rng.normal(size=px.shape)
        cov = noise_px**2 * np.eye(2 * len(corners))
        sightings = [Sighting(corners, px[:, eye], cov, right=bool(eye)) for eye in range(len(calibration.eyes_m))]
        estimator = PoseEstimator(calibration, sightings)
        flat = estimator.refine(rotation, PLACE)
        assert flat is not None
        for pose, errors in ((flat, off_flat), (estimator.bent(flat, heights), off_bent)):
            turn = Rotation.from_matrix(pose.rotation @ rotation.T).as_rotvec()
            errors.append(np.concatenate([turn, pose.x - PLACE]) / np.sqrt(np.diag(pose.cov)))
    assert np.sqrt(np.square(off_flat).mean(axis=0)).max() > 3.0
    assert 0.6 < (np.abs(off_bent) < 1.0).mean() < 0.8


@pytest.mark.parametrize("squares", [(8, 5), (7, 5), (8, 4), (9, 6), (11, 8)], ids=str)
def test_larger_chessboard_is_refused_by_its_squares(squares, caplog) -> None:
    found = tracker_of(ONE, BOARD).track(photographed("one", shown(facing(15.0), squares=squares)))
    assert isinstance(found, MarkerMiss)
    assert found.reason is Reason.REPROJECTION
    assert "squares is in view, not one of 7x4" in caplog.text


def test_smaller_chessboard_is_a_part_of_it() -> None:
    found = tracker_of(ONE, BOARD).track(photographed("one", shown(facing(15.0), squares=(6, 4))))
    assert isinstance(found, MarkerMiss)
    assert found.reason is Reason.OCCLUDED


@pytest.mark.parametrize("eyes", EYES)
@pytest.mark.parametrize("covered", [0.35, 0.5, 0.8])
def test_covered_chessboard_is_no_fix(eyes, covered) -> None:
    rotation, half = facing(20.0), 0.06
    along = 0.5 * SQUARES[0] * SIDE_M * (2.0 * covered - 1.0) - half
    card = Card(rotation, PLACE + rotation @ np.array([along, 0.0, 0.002]), half)
    found = tracker_of(EYES[eyes], BOARD).track(photographed(eyes, shown(rotation), card))
    assert isinstance(found, MarkerMiss)
    assert found.reason in (Reason.OCCLUDED, Reason.NO_MARKER)


def test_outer_squares_may_be_cut_short() -> None:
    rotation = facing(15.0)
    cut = PLACE + rotation @ np.array([0.0, (-0.5 * SQUARES[1] + 1.0 - 0.38) * SIDE_M - 0.06, 1e-4])
    paper = Card(rotation, cut, 0.06, grey=0.85)
    error, sigma = off(tracker_of(ONE, BOARD).track(photographed("one", shown(rotation), paper)), rotation)
    assert (np.abs(error) < 4.5 * sigma).all()


def test_finger_over_a_corner_is_never_confidently_wrong() -> None:
    rotation, fixes = facing(20.0), 0
    for k, across in enumerate(np.linspace(-4.2, 4.2, 15)):
        spot = PLACE + rotation @ np.array([across * SIDE_M, -2.0 * SIDE_M, 0.003])
        finger = Card(rotation, spot, 0.45 * SIDE_M, grey=0.6)
        found = tracker_of(ONE, BOARD).track(photographed("one", shown(rotation), finger, seed=k))
        if isinstance(found, MarkerFix):
            error, sigma = off(found, rotation)
            assert (np.abs(error) < 5.0 * sigma).all(), across
            fixes += 1
    assert fixes


def test_chessboard_is_followed_from_frame_to_frame() -> None:
    tracker = tracker_of(ONE, BOARD)
    for k in range(3):
        rotation, x = facing(20.0 + k), PLACE + np.array([0.004 * k, 0.0, 0.0])
        error, sigma = off(tracker.track(photographed("one", shown(rotation, x), seed=k, t=0.03 * k)), rotation, x)
        assert (np.abs(error) < 5.0 * sigma).all()


def test_blank_wall_has_no_chessboard() -> None:
    found = tracker_of(SMALL, BOARD).track(photographed("two"))
    assert isinstance(found, MarkerMiss)
    assert found.reason is Reason.NO_MARKER


def test_chessboard_is_drawn_into_its_image() -> None:
    frame = photographed("one", shown(facing(20.0)))
    annotated = Annotator(ONE, BOARD).annotated(frame, tracker_of(ONE, BOARD).track(frame))
    assert (annotated[40:200, 60:300] != frame.left[40:200, 60:300]).any(axis=2).sum() > 200


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ({"columns": 8, "rows": 6}, "8x6 squares looks the same turned by half a turn.*an even and an odd number"),
        ({"columns": 7, "rows": 5}, "7x5 squares looks the same turned by half a turn"),
        ({"columns": 8, "rows": 3}, "8x3 squares is too small. Take 4 and more each way"),
    ],
)
def test_chessboard_without_one_way_up_is_refused(shape, said) -> None:
    with pytest.raises(msgspec.ValidationError, match=said):
        msgspec.convert({"marker": "chessboard", "chessboard": {**shape, "square_m": 0.03}}, VisionConfig)


def test_chessboard_needs_its_table() -> None:
    with pytest.raises(ConfigError, match=r"Add \[vision.chessboard\] with its columns, rows and square_m"):
        tracker_of(ONE, VisionConfig(marker="chessboard"))
