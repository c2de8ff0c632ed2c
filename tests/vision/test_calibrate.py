"""Stereo calibration against planted cameras, and its refusals."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_renderer import Photographer, Printed, Taken, poses, webcams
from scipy.spatial.transform import Rotation
from shown_board import BOARD, NOISE_PX, SIZE, corner_views, photographed, true_vector, view_of

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.board import Corners, NotFound
from bodyschema.vision.calibration.bundle import POSE, Linear
from bodyschema.vision.calibration.calibrate import CalibrationRequest, Fitted, calibrate, fit
from bodyschema.vision.calibration.gather import Unusable, gathered, require_both, summary_lines
from bodyschema.vision.calibration.guidance import Coverage
from bodyschema.vision.calibration.held_out import covariance
from bodyschema.vision.calibration.image_pairs import ImagePair
from bodyschema.vision.calibration.view import View
from bodyschema.vision.calibration.weights import corner_weights
from bodyschema.vision.rig.lens import Lens
from bodyschema.vision.rig.stereo_rig import CalibrationError, lenses_of

ASKED = CalibrationRequest(SIZE, ("A1", "B2"), "2026-01-01T00:00:00Z", scale_sigma=0.0)
PINHOLE = replace(ASKED, model="pinhole")


def swapped(view: View) -> View:
    return View(view.name, view.right, view.left)


def sigmas(found: Fitted) -> FloatArray:
    return np.sqrt(np.diag(covariance(found.views, BOARD.corners_m, found.bundle)))


def upside_down(corners: Corners | None) -> Corners | None:
    return None if corners is None else replace(corners, px=np.array(SIZE) - 1 - corners.px)


def refusal(views: list[View], asked: CalibrationRequest = PINHOLE, board=BOARD) -> str:
    with pytest.raises(CalibrationError) as raised:
        calibrate(views, board, asked)
    return str(raised.value)


@pytest.fixture(scope="module")
def planted() -> tuple:
    rng = np.random.default_rng(11)
    rig = webcams(rng)
    return rig, corner_views(rig, rng, 10)


# --- results


@pytest.mark.soak
def test_intervals_cover_over_many_rigs() -> None:
    misses = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rig = webcams(rng, fisheye=seed % 2 == 1)
        found = fit(corner_views(rig, rng, 14), BOARD.corners_m, SIZE, "fisheye" if seed % 2 else "pinhole")
        misses.append((found.bundle.vector - true_vector(rig)) / sigmas(found))
    z = np.abs(np.concatenate(misses))
    # Parameters of one rig are not independent: 4 rigs are worth about thirty.
    assert 0.55 < np.mean(z < 1.0) < 0.81
    assert np.mean(z < 2.0) > 0.88


@pytest.mark.soak
def test_intervals_cover_correlated_corners_within_views() -> None:
    misses = []
    for seed in range(2):
        rng = np.random.default_rng(40 + seed)
        rig = webcams(rng)
        found = fit([curved(view, rng) for view in corner_views(rig, rng, 14)], BOARD.corners_m, SIZE, "pinhole")
        misses.append((found.bundle.vector - true_vector(rig)) / sigmas(found))
    assert np.mean(np.abs(np.concatenate(misses)) < 2.0) > 0.85


def test_baseline_sigma_matches_jackknife_over_views() -> None:
    rng = np.random.default_rng(0)
    moved = np.linspace(0.0, 0.4, 14)[:, None] * rng.standard_normal((14, 2))  # [px], between the two images
    views = [
        replace(view, right=replace(view.right, px=view.right.px + off))
        for view, off in zip(corner_views(webcams(rng), rng, 14), moved, strict=True)
    ]
    found = fit(views, BOARD.corners_m, SIZE, "pinhole")
    assert found.left_out == ()
    without = np.array(
        [
            fit([*views[:k], *views[k + 1 :]], BOARD.corners_m, SIZE, "pinhole").bundle.vector[-3:]
            for k in range(len(views))
        ]
    )
    jackknife = np.sqrt((len(views) - 1) * without.var(axis=0))
    np.testing.assert_allclose(sigmas(found)[-3:], jackknife, rtol=0.2)


def curved(view: View, rng: np.random.Generator) -> View:
    """Return a view whose corners are moved together, 0.3 px at the ends, as by paper that curls."""
    bends = 0.3 * rng.standard_normal((2, 2))

    def moved(corners: Corners | None) -> Corners | None:
        if corners is None:
            return None
        away = BOARD.corners_m[corners.numbers, :2] / np.abs(BOARD.corners_m[:, :2]).max()
        return replace(corners, px=corners.px + (away**2 - (away**2).mean(axis=0)) @ bends)

    return View(view.name, moved(view.left), moved(view.right))


def test_opencvs_stereo_calibration_agrees(planted) -> None:
    _, views = planted
    views = [view for view in views if len(view.left) == len(view.right) == len(BOARD.corners_m)]
    found = fit(views, BOARD.corners_m, SIZE, "pinhole")
    ours = found.bundle
    model = [BOARD.corners_m.astype(np.float32)] * len(views)
    eyes = [[getattr(view, eye).px.astype(np.float32) for view in views] for eye in ("left", "right")]
    start = [cv2.calibrateCamera(model, px, SIZE, np.eye(3), np.zeros(5))[1:3] for px in eyes]
    theirs = cv2.stereoCalibrate(model, *eyes, *start[0], *start[1], SIZE, flags=cv2.CALIB_USE_INTRINSIC_GUESS)
    sigma = sigmas(found)
    assert abs(ours.vector[0] - theirs[1][0, 0]) < 0.5 * sigma[0]
    np.testing.assert_array_less(np.abs(ours.vector[-3:] - theirs[6].ravel()), 0.5 * sigma[-3:])


def test_views_of_one_eye_alone_count_too(planted) -> None:
    _, views = planted
    alone = [replace(view, right=None) if k % 3 == 0 else view for k, view in enumerate(views)]
    without = [view for view in alone if view.is_stereo]
    all_of_them, pairs_alone = (sigmas(fit(each, BOARD.corners_m, SIZE, "pinhole")) for each in (alone, without))
    assert all_of_them[0] < pairs_alone[0]


@pytest.mark.parametrize("fisheye", [pytest.param(False, marks=pytest.mark.soak), True])
def test_better_predicting_lens_model_is_chosen(fisheye) -> None:
    rng = np.random.default_rng(4)
    rig = webcams(rng, fisheye=fisheye)
    found = calibrate(corner_views(rig, rng, 9), BOARD, ASKED)
    assert found.rig.model == ("fisheye" if fisheye else "pinhole")


def test_folding_lens_model_is_refused(planted, monkeypatch) -> None:
    monkeypatch.setattr(Lens, "is_one_to_one", lambda lens, _: False)
    with pytest.raises(CalibrationError, match="the pinhole model folds over within the image"):
        fit(planted[1][:9], BOARD.corners_m, SIZE, "pinhole")


def test_a_model_that_is_refused_leaves_the_others(planted, monkeypatch) -> None:
    def only_fisheye(views, corners_m, size_px, model, eyes) -> Fitted:
        if model != "fisheye":
            raise CalibrationError("it folds over")
        return fit(views, corners_m, size_px, model, eyes)

    monkeypatch.setattr("bodyschema.vision.calibration.calibrate.fit", only_fisheye)
    told: list[str] = []
    found = calibrate(planted[1][:10], BOARD, ASKED, told.append)
    assert list(found.held_out_by_model_px) == ["fisheye"]
    assert "pinhole lenses do not fit: it folds over" in told


def test_prior_keeps_lens_of_far_views_from_folding(planted) -> None:
    rig, rng = planted[0], np.random.default_rng(1)
    photographer = Photographer(rig, Printed(), Taken(), rng)
    far = []
    for k in range(12):
        R = Rotation.from_euler("xyz", rng.uniform(-0.6, 0.6, 3)).as_matrix()
        place = np.array([0.03 + rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05), 1.0])
        far.append(view_of(str(k), photographer, (R, place - R @ [0.12, 0.09, 0.0]), rng, 0.1))
    bundle = fit(far, BOARD.corners_m, SIZE, "pinhole").bundle
    assert bundle.prior.any()  # without it, the fit folds over in the image's corners
    assert all(lens.is_one_to_one(SIZE) for lens in lenses_of("pinhole", bundle.vector))
    assert np.linalg.norm(bundle.vector[-3:]) == pytest.approx(rig.baseline_m, rel=0.02)


def test_held_out_error_matches_noise_of_new_views(planted) -> None:
    _, views = planted
    found = fit(views, BOARD.corners_m, SIZE, "pinhole")
    assert found.held_out.rms_px == pytest.approx(NOISE_PX, rel=0.1)
    assert found.held_out.rms_px > found.bundle.sigma_px


def test_view_moved_between_eyes_is_left_out(planted) -> None:
    _, views = planted
    moved = replace(views[6], right=replace(views[6].right, px=views[6].right.px + np.array([2.5, 0.5])))
    found = fit([*views[:6], moved, *views[7:]], BOARD.corners_m, SIZE, "pinhole")
    assert [each.name for each in found.left_out] == [moved.name]
    assert found.left_out[0].rms_px > 5 * found.left_out[0].usual_px


def test_outlier_corner_is_left_out_keeping_its_view(planted) -> None:
    _, views = planted
    px = views[6].right.px.copy()
    px[3] += np.array([1.0, 0.6])
    found = fit(
        [*views[:6], replace(views[6], right=replace(views[6].right, px=px)), *views[7:]],
        BOARD.corners_m,
        SIZE,
        "pinhole",
    )
    assert found.left_out == ()
    assert np.flatnonzero(found.bundle.weights[6] == 0.0).tolist() == [len(views[6].left) + 3]


def test_views_that_were_found_less_exactly_count_less(planted) -> None:
    rig, _ = planted
    rng = np.random.default_rng(21)
    views = [*corner_views(rig, rng, 10, 0.02), *corner_views(rig, rng, 10, 0.08)]
    weights = fit(views, BOARD.corners_m, SIZE, "pinhole").bundle.weights
    good, poor = (np.mean(np.concatenate(each)) for each in (weights[:10], weights[10:]))
    assert 8.0 < good / poor < 24.0


def test_board_size_uncertainty_carries_over_to_baseline(planted) -> None:
    _, views = planted
    sure, unsure = (calibrate(views, BOARD, replace(PINHOLE, scale_sigma=each)).rig for each in (0.0, 0.002))
    expected = np.hypot(sure.baseline_sigma_m, 0.002 * sure.baseline_m)
    assert unsure.baseline_sigma_m == pytest.approx(expected, rel=1e-6)


# --- refusals and their reasons


def test_swapped_cameras_are_named(planted) -> None:
    _, views = planted
    said = refusal([swapped(view) for view in views])
    assert re.search(r"the cameras are swapped: the right one is \d\d mm to the left of the left one", said)


def test_a_camera_that_is_upside_down_is_named(planted) -> None:
    _, views = planted
    assert "one camera is upside down" in refusal([replace(view, right=upside_down(view.right)) for view in views])


def test_too_few_views_are_named(planted) -> None:
    _, views = planted
    assert "too few views: both eyes saw the board in 5, at least 8" in refusal(views[:5])


def test_views_that_all_face_the_cameras_are_named(planted) -> None:
    rig, _ = planted
    rng = np.random.default_rng(1)
    photographer = Photographer(rig, Printed(), Taken(), rng)
    frontal = []
    for k in range(16):
        R = Rotation.from_euler("zxy", [rng.normal(0, 0.2), *rng.normal(0, 0.02, 2)]).as_matrix()
        place = np.array([rng.uniform(-0.12, 0.2), rng.uniform(-0.12, 0.12), rng.uniform(0.45, 0.8)])
        view = view_of(str(k), photographer, (R, place - R @ [0.12, 0.09, 0.0]), rng)
        if min(len(view.left), len(view.right)) >= 8:
            frontal.append(view)
    assert "the board faces the cameras in all views" in refusal(frontal)


def test_uncovered_image_regions_are_named(planted) -> None:
    rig, _ = planted
    rng = np.random.default_rng(1)
    photographer = Photographer(rig, Printed(), Taken(), rng)
    views = []
    for k in range(14):
        R = Rotation.from_rotvec(rng.normal(0, 0.4, 3)).as_matrix()
        views.append(view_of(str(k), photographer, (R, np.array([-0.2, -0.14, 1.3]) - R @ [0.12, 0.09, 0.0]), rng))
    said = refusal(views)
    assert re.search(r"these parts of the left image: .*lower right", said)


def test_shrunken_board_is_contradicted_by_measured_baseline(planted) -> None:
    rig, _ = planted
    rng = np.random.default_rng(3)
    small = Printed(square_m=0.97 * 0.030)
    photographer = Photographer(rig, small, Taken(), rng)
    views = [view_of(str(k), photographer, pose, rng) for k, pose in enumerate(poses(rng, rig, small, 12))]
    by_hand = replace(PINHOLE, baseline_m=round(rig.baseline_m, 3))
    assert "make the squares 97" in refusal(views, by_hand)
    assert calibrate(views, replace(BOARD, square_m=0.97 * 0.030), by_hand).rig.provenance.views == 12


def test_excessive_pixel_noise_fails_held_out_error_check(planted) -> None:
    rig, _ = planted
    views = corner_views(rig, np.random.default_rng(5), 9, noise_px=1.5)
    assert re.search(r"views that were not fitted are off by 1\.\d+ px, 0.96 px is the most", refusal(views))


def test_eyes_of_different_resolutions_are_named() -> None:
    _, pairs, _ = photographed(count=3)
    smaller = ImagePair("00", pairs[0].left, pairs[0].right[::2, ::2])
    with pytest.raises(CalibrationError, match=r"the left image has 640x480 pixels, the right one 320x240"):
        gathered([smaller], BOARD)


def test_unusable_images_error_gives_most_common_reason() -> None:
    black = np.zeros((120, 160, 3), np.uint8)
    found = gathered([ImagePair(str(k), black, black) for k in range(3)], BOARD)
    with pytest.raises(CalibrationError, match=r"6 of 6: the image is black. Take the lens cap off"):
        require_both(found)


def test_eye_never_seeing_board_is_named_with_reason() -> None:
    _, pairs, _ = photographed(count=3)
    found = gathered([ImagePair(pair.name, pair.left, np.zeros_like(pair.right)) for pair in pairs[:3]], BOARD)
    with pytest.raises(CalibrationError, match=r"no right image .*; 3 of 3: the image is black. Take the lens cap off"):
        require_both(found)


@pytest.mark.soak  # of the command: tests/cli/test_cameras_command.py
def test_three_pairs_suffice_to_report_another_board() -> None:
    _, pairs, _ = photographed(count=6)
    taken: list[str] = []

    def counted() -> Iterator[ImagePair]:
        for pair in pairs:
            taken.append(pair.name)
            yield pair

    found = gathered(counted(), replace(BOARD, dictionary="5X5_50"))
    assert len(taken) == 3
    with pytest.raises(CalibrationError, match=r"6 of 6: the markers are 4X4_50, not 5X5_50. Give --dictionary 4X4_50"):
        require_both(found)


def test_board_search_reports_progress() -> None:
    black = np.zeros((120, 160), np.uint8)
    told: list[str] = []
    gathered([ImagePair(str(k), black, black) for k in range(20)], BOARD, told.append)
    assert told[:2] == ["10 pairs looked at; the board is in 0", "20 pairs looked at; the board is in 0"]


def test_images_with_same_fault_share_one_line() -> None:
    blurred = NotFound("blurred", "the sharpest edge has 3.7 px"), NotFound("blurred", "the sharpest edge has 2.9 px")
    unusable = [Unusable(f"{k:02d}", "left", blurred[k == 2]) for k in range(6)]
    unusable.append(Unusable("03", "right", NotFound("not_found", "no board")))
    assert summary_lines(unusable) == [
        "00, 01, 02 and 3 more, left image: the sharpest edge has 3.7 px",
        "03, right image: no board",
    ]


# --- guidance


def test_nothing_is_missing_of_a_careful_persons_views(planted) -> None:
    _, views = planted
    more = corner_views(planted[0], np.random.default_rng(9), 30)
    assert Coverage.of([*views, *more], BOARD, SIZE).missing() == []


@pytest.mark.parametrize(
    ("axis", "said"),
    [([0, 1, 0], "right edge"), ([0, -1, 0], "left edge"), ([1, 0, 0], "upper edge"), ([-1, 0, 0], "lower edge")],
)
def test_shown_tilt_is_not_requested_again(planted, axis, said) -> None:
    rig, _ = planted
    rng = np.random.default_rng(1)
    photographer = Photographer(rig, Printed(), Taken(), rng)
    R = Rotation.from_rotvec(-0.5 * np.array(axis)).as_matrix()
    place = np.array([0.03, 0.0, 0.5])
    away = {"right edge": R[2, 0], "left edge": -R[2, 0], "lower edge": R[2, 1], "upper edge": -R[2, 1]}
    assert away[said] > 0.4
    view = view_of("0", photographer, (R, place - R @ [0.12, 0.09, 0.0]), rng)
    wishes = [wish for wish in Coverage.of([view, view], BOARD, SIZE).missing() if "tilt" in wish and "edge" in wish]
    assert len(wishes) == 3
    assert not any(said in wish for wish in wishes)


def test_indefinite_normal_equations_have_no_step() -> None:
    normal, mixed = np.full((1, 1), 1e10), np.full((1, 1, POSE), 1e10)
    poses = 1e10 * np.eye(POSE)[None]
    at = Linear(
        vector=np.zeros(1),
        poses=np.zeros((1, POSE)),
        residuals=[],
        weights=[],
        normal=normal,
        gradient=np.ones(1),
        pose_normals=poses,
        pose_gradients=np.ones((1, POSE)),
        mixed=mixed,
        penalty=0.0,
    )
    assert at.step(0.0) is None


def test_fit_with_unsolvable_equations_is_refused() -> None:
    rng = np.random.default_rng(0)
    found = fit(corner_views(webcams(rng), rng, 14), BOARD.corners_m, SIZE, "pinhole")
    nowhere = replace(found.bundle, normal=-found.bundle.normal)
    with pytest.raises(CalibrationError, match="the views do not determine the lenses"):
        corner_weights(found.views, BOARD.corners_m, nowhere)
