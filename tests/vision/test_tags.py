from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_renderer import SMALL, Look
from numpy.typing import ArrayLike
from scenes import reason
from scipy.spatial.transform import Rotation
from tag_renderer import Card, Sheet, photograph

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError, SourceError
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, MarkerMiss, Reason, StereoFrame
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.pose import PoseEstimator, Sighting, mirrored
from bodyschema.vision.tags.bleed import bleed
from bodyschema.vision.tags.body import TAG_CORNERS, TagBody
from bodyschema.vision.tags.config import ClusterConfig, PlacedTag, TagConfig
from bodyschema.vision.tags.dictionary import tag_modules
from bodyschema.vision.tags.edge import PIXEL_CUMULANT, blurred_step
from bodyschema.vision.tags.image import TagImage, measure_tag
from bodyschema.vision.tags.settings import EdgeSettings
from bodyschema.vision.tags.tracker import TagTracker
from bodyschema.vision.trackers import tracker_of
from kbmaps import rotation_vectors

SIDE_M = 0.03
CONFIG = TagConfig(side_m=SIDE_M)
WALL = Look(wall=0.4, samples=6)
FACING = np.diag([1.0, -1.0, -1.0])
MIDDLE = np.array([0.02, 0.0, 0.4])
# Two tags on faces of a cube, in the cube's frame.
PLACED = (PlacedTag(id=1, xyz=(0.0, 0.0, 0.02)), PlacedTag(id=2, xyz=(0.02, 0.0, 0.0), rpy=(0.0, np.pi / 2, 0.0)))
CUBE = TagBody.cluster(ClusterConfig(tags=PLACED), CONFIG)


def tracker(config: TagConfig = CONFIG, calibration: StereoCalibration = SMALL) -> TagTracker:
    return TagTracker(calibration, TagBody.single(config), config)


def tilted(about: ArrayLike, degrees: float) -> FloatArray:
    axis = np.asarray(about, dtype=np.float64) / np.linalg.norm(about)
    return Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix() @ FACING


def sheet(id: int = 0, rotation: FloatArray = FACING, x: ArrayLike = MIDDLE, side_m: float = SIDE_M) -> Sheet:
    return Sheet(id, rotation, np.asarray(x, dtype=np.float64), side_m)


def seen(*things: Sheet | Card, seed: int = 0, t: float = 0.0, look: Look = WALL) -> StereoFrame:
    return photograph(things, SMALL, look, np.random.default_rng(seed), t=t)


def cube_at(rotation: FloatArray, x: FloatArray) -> list[Sheet]:
    """Return the two tags of the cube at this pose."""
    return [
        sheet(tag.id, rotation @ Rotation.from_euler("xyz", tag.rpy).as_matrix(), x + rotation @ np.array(tag.xyz))
        for tag in PLACED
    ]


def off(answer: MarkerFix | MarkerMiss, rotation: FloatArray, x: FloatArray) -> tuple[float, float]:
    """Return errors of position and turn in units of their own stated covariance; infinite for a miss."""
    if isinstance(answer, MarkerMiss) or answer.R is None or answer.cov_R is None:
        return np.inf, np.inf
    turned = rotation_vectors((Rotation.from_quat(answer.R).as_matrix() @ rotation.T)[None])[0]
    moved = answer.x - x
    return _length(moved, answer.cov), _length(turned, answer.cov_R)


def _length(error: FloatArray, cov: FloatArray) -> float:
    return float(np.sqrt(error @ np.linalg.solve(cov, error)))


@pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0])
def test_tag_pose_error_is_within_its_covariance(degrees) -> None:
    rotation = tilted([1.0, 0.5, 0.3], degrees)
    assert max(off(tracker().track(seen(sheet(rotation=rotation))), rotation, MIDDLE)) < 4.0


def sigmas_off(frames: int, seed: int) -> FloatArray:
    """Return errors of position and turn (n, 6) in units of their stated sigmas, tags at random poses."""
    rng, off_by = np.random.default_rng(seed), []
    found = tracker()
    for number in range(frames):
        axis = np.append(rng.normal(size=2), 0.0)
        rotation = tilted(axis, rng.uniform(0.0, 45.0)) @ Rotation.from_euler("z", rng.uniform(0, 6.3)).as_matrix()
        x = MIDDLE + rng.uniform((-0.02, -0.02, -0.1), (0.02, 0.02, 0.05))
        answer = found.track(seen(sheet(rotation=rotation, x=x), seed=number, t=10.0 * number))
        if isinstance(answer, MarkerFix) and answer.R is not None and answer.cov_R is not None:
            turned = rotation_vectors((Rotation.from_quat(answer.R).as_matrix() @ rotation.T)[None])[0]
            sigmas = np.sqrt([*np.diag(answer.cov), *np.diag(answer.cov_R)])
            off_by.append(np.array([*(answer.x - x), *turned]) / sigmas)
    return np.array(off_by)


@pytest.mark.soak
def test_few_errors_are_larger_than_two_claimed_sigmas() -> None:
    off_by = sigmas_off(15, seed=1)
    assert len(off_by) >= 13
    assert (np.abs(off_by) < 2.0).mean() > 0.85


def test_corners_come_out_to_hundredths_of_a_pixel() -> None:
    answer = tracker().track(seen(sheet(), look=replace(WALL, noise_sd=1.0)))
    assert isinstance(answer, MarkerFix)
    assert np.abs(np.array(answer.centres_px) - SMALL.project(MIDDLE)).max() < 0.03


@pytest.mark.parametrize("blur_px", [0.4, 0.8, 1.4])
def test_blur_from_neighbouring_modules_pulls_no_edge(blur_px) -> None:
    # Modules of 5 px, before a dark wall.
    rotation, side_m = tilted([0.0, 0.0, 1.0], 20.0), 5.0 * 8 * 0.4 / SMALL.focal_px
    frame = seen(
        sheet(rotation=rotation, side_m=side_m), look=Look(wall=0.1, samples=12, noise_sd=0.5, blur_px=blur_px)
    )
    corners = MIDDLE + side_m * TAG_CORNERS @ rotation.T
    true = SMALL.focal_px * corners[:, :2] / corners[:, 2:] + SMALL.principal_point_px
    tag = measure_tag(grey_of(frame), 0, true + 0.4, CONFIG)
    assert isinstance(tag, TagImage)
    assert np.abs(tag.corners_px - true).max() < 0.06


PHOTOGRAPHED = {
    "a lamp at one side": replace(WALL, light_slope=(0.5, -0.3), ambient=0.25),
    "halos": replace(WALL, sharpen=1.5),
    "phone": replace(WALL, sharpen=1.0, bayer=True, denoise=4.0, jpeg=75),
    "tone curve": replace(WALL, tone=1 / 2.2),
}


def grey_of(frame: StereoFrame) -> ImageArray:
    return np.asarray(cv2.cvtColor(frame.left, cv2.COLOR_BGR2GRAY), np.uint8)


def corners_in_the_left_eye(rotation: FloatArray) -> FloatArray:
    corners = MIDDLE + SIDE_M * TAG_CORNERS @ rotation.T
    return SMALL.focal_px * corners[:, :2] / corners[:, 2:] + SMALL.principal_point_px


def measured(thing: Sheet, look: Look = WALL) -> TagImage | Reason:
    grey = grey_of(seen(thing, look=look))
    return measure_tag(grey, 0, corners_in_the_left_eye(thing.rotation) + 0.4, CONFIG)


@pytest.mark.parametrize("look", PHOTOGRAPHED.values(), ids=PHOTOGRAPHED)
def test_no_camera_moves_a_corner_far(look) -> None:
    rotation = tilted([1.0, 1.0, 0.3], 12.0)
    tag = measured(sheet(rotation=rotation), look)
    assert isinstance(tag, TagImage)
    assert np.abs(tag.corners_px - corners_in_the_left_eye(rotation)).max() < 0.1


BLEEDING = {
    "tone curve": replace(WALL, tone=1 / 2.2),
    "overexposed": replace(WALL, exposure=2.2),
    "far overexposed": replace(WALL, exposure=4.0),
}


@pytest.mark.parametrize("look", BLEEDING.values(), ids=BLEEDING)
def test_white_bleeding_into_black_shrinks_no_tag(look) -> None:
    rotation = tilted([1.0, -0.5, 0.0], 15.0)
    tag, true = measured(sheet(rotation=rotation), look), corners_in_the_left_eye(rotation)
    assert isinstance(tag, TagImage)
    outward = (true - true.mean(axis=0)) / np.linalg.norm(true - true.mean(axis=0), axis=1)[:, None]
    assert abs(float(((tag.corners_px - true) * outward).sum(axis=1).mean())) < 0.07


@pytest.mark.parametrize("seed", range(5))
def test_chance_is_not_taken_for_bleeding(seed) -> None:
    grey = grey_of(seen(sheet(), seed=seed, look=replace(WALL, blur_px=0.5)))
    moved, variance = bleed(grey, corners_in_the_left_eye(FACING), 0.7, tag_modules(CONFIG.dictionary, 0))
    assert abs(moved) < 0.002
    assert 0.0 < variance < 0.005**2


@pytest.mark.parametrize("level", [0, 128])
@pytest.mark.parametrize("blur_px", [0.05, 2.0])
def test_a_surface_of_one_grey_leaves_bleeding_unknown(level, blur_px) -> None:
    grey, square = np.full((120, 160), level, np.uint8), 40.0 + 50.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    moved, variance = bleed(grey, square, blur_px, np.zeros((6, 6)))
    assert moved == 0.0
    assert 0.0 < variance < np.inf


def test_a_covered_pattern_leaves_bleeding_unknown() -> None:
    plain = measured(sheet())
    frame = seen(sheet(), Card(FACING, MIDDLE - [0.0, 0.0, 0.01], 0.008, grey=0.9))
    covered = measure_tag(grey_of(frame), 0, corners_in_the_left_eye(FACING), CONFIG)
    assert isinstance(plain, TagImage)
    assert isinstance(covered, TagImage)
    assert np.trace(covered.cov_px) > 10.0 * np.trace(plain.cov_px)


def test_edge_error_floor_is_not_added_to_noise(monkeypatch) -> None:
    answers = []
    for least_px in (0.0, 0.0007):
        monkeypatch.setattr("bodyschema.vision.tags.edge._Settings.floor_px", least_px)
        answers.append(measured(sheet()))
    first, then = answers
    assert isinstance(first, TagImage)
    assert np.array_equal(first.cov_px, then.cov_px)


def test_bent_edges_are_claimed_to_be_less_sure() -> None:
    # Less than half a wave along each edge, 0.1 px high, as a lens or curled paper bends them.
    grey = grey_of(seen(sheet()))
    v, u = np.indices(grey.shape, dtype=np.float32)
    bent = np.asarray(
        cv2.remap(grey, u + 0.1 * np.sin(v / 20.0), v + 0.1 * np.sin(u / 26.0), cv2.INTER_CUBIC), np.uint8
    )
    true = corners_in_the_left_eye(FACING)
    straight, curved = (measure_tag(image, 0, true, CONFIG) for image in (grey, bent))
    assert isinstance(straight, TagImage)
    assert isinstance(curved, TagImage)
    assert np.trace(curved.cov_px) > 5.0 * np.trace(straight.cov_px)


def test_a_tag_with_half_a_margin_is_measured() -> None:
    tag = measured(replace(sheet(rotation=tilted([0.0, 1.0, 0.3], 20.0)), margin=0.45), replace(WALL, wall=0.05))
    assert isinstance(tag, TagImage)
    assert np.abs(tag.corners_px - corners_in_the_left_eye(tilted([0.0, 1.0, 0.3], 20.0))).max() < 0.3


def test_a_large_tag_is_found_from_rough_corners() -> None:
    side_m = 0.09
    corners = MIDDLE + side_m * TAG_CORNERS @ FACING.T
    true = SMALL.focal_px * corners[:, :2] / corners[:, 2:] + SMALL.principal_point_px
    grey = grey_of(seen(sheet(side_m=side_m), look=replace(WALL, samples=2)))
    inside = true + 0.11 * (true.mean(axis=0) - true)  # 7 px an edge: the detector's polygon cuts corners off
    tag = measure_tag(grey, 0, inside, CONFIG)
    assert isinstance(tag, TagImage)
    assert np.abs(tag.corners_px - true).max() < 0.1


def test_a_curled_sheet_is_measured_with_less_certainty() -> None:
    flat, curled = measured(sheet()), measured(replace(sheet(), curl=6.0, rotation=tilted([1.0, 0.0, 0.0], 40.0)))
    assert isinstance(flat, TagImage)
    assert isinstance(curled, TagImage)
    assert np.trace(curled.cov_px) > 2.0 * np.trace(flat.cov_px)


def test_followed_tag_is_found_after_step_and_jump() -> None:
    # No edge along the pixels: there the renderer, which blurs after pixels, unlike a lens, is off by 0.015 px.
    found, rotation = tracker(), tilted([0.2, 1.0, 0.3], 20.0)
    for number, x in enumerate(MIDDLE + np.array([[0.0, 0.0, 0.0], [0.004, 0.0, 0.0], [-0.04, 0.03, 0.05]])):
        frame = seen(sheet(rotation=rotation, x=x), t=number / 30.0, seed=number)
        assert max(off(found.track(frame), rotation, x)) < 4.0


def test_an_empty_picture_has_no_marker() -> None:
    assert reason(tracker().track(seen(look=Look(samples=2)))) is Reason.NO_MARKER


def test_a_tag_of_another_number_is_no_marker() -> None:
    assert reason(tracker().track(seen(sheet(id=7)))) is Reason.NO_MARKER


def reasons(frame: StereoFrame, frames: int = 10) -> set[Reason | None]:
    """Return the reasons why one frame after another is rejected."""
    found = tracker()
    return {reason(found.track(replace(frame, t=0.1 * number))) for number in range(frames)}


def test_a_mirrored_tag_is_named() -> None:
    right, left = (eye[:, ::-1].copy() for eye in seen(sheet()).images)
    assert reasons(StereoFrame(0.0, left, right), 2) == {Reason.MIRRORED}


@pytest.mark.parametrize("dictionary", [cv2.aruco.DICT_6X6_50, cv2.aruco.DICT_4X4_50, cv2.aruco.DICT_APRILTAG_25h9])
def test_a_tag_of_another_dictionary_is_named(dictionary, caplog) -> None:
    drawn = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(dictionary), 3, 80)
    frame = seen()
    for eye in frame.images:
        eye[60:180, 100:220] = 220
        eye[80:160, 120:200] = drawn[..., None]
    assert Reason.OTHER_FAMILY in reasons(frame)
    assert len(caplog.messages) == 1
    assert "not one of apriltag_36h11" in caplog.text


def test_tag_too_small_to_measure_is_no_marker() -> None:
    assert reason(tracker().track(seen(sheet(x=[0.02, 0.0, 1.2])))) is Reason.NO_MARKER


def test_the_same_tag_twice_is_ambiguous() -> None:
    twice = seen(sheet(x=[-0.02, 0.0, 0.4]), sheet(x=[0.06, 0.0, 0.4]))
    assert reason(tracker().track(twice)) is Reason.AMBIGUOUS


@pytest.mark.parametrize("printed", [0.9, 0.97, 0.98, 0.99, 1.01, 1.03, 1.1])
def test_tag_printed_in_another_size_is_size_mismatch(printed) -> None:
    assert reason(tracker().track(seen(sheet(side_m=printed * SIDE_M)))) is Reason.SIZE_MISMATCH


def test_rows_that_disagree_are_epipolar() -> None:
    frame = seen(sheet())
    left, right = frame.images
    assert reason(tracker().track(StereoFrame(frame.t, left, np.roll(right, 4, axis=0)))) is Reason.EPIPOLAR


def test_eyes_that_are_interchanged_are_epipolar() -> None:
    frame = seen(sheet())
    assert reason(tracker().track(replace(frame, left=frame.right, right=frame.left))) is Reason.EPIPOLAR


def test_tag_at_one_eye_s_border_gives_no_fix() -> None:
    u = -SMALL.principal_point_px[0] * 0.4 / SMALL.focal_px
    x = np.array([u + SMALL.baseline_m + SIDE_M / 2 + 0.0005, 0.0, 0.4])
    assert reason(tracker().track(seen(sheet(x=x)))) in {Reason.AT_BORDER, Reason.NO_MARKER}


@pytest.mark.parametrize("covered", [0.1, 0.3, 0.5, 0.8])
def test_a_covered_tag_is_never_a_wrong_fix(covered) -> None:
    edge = MIDDLE[0] - SIDE_M / 2 + covered * SIDE_M - 0.01
    finger = Card(FACING, np.array([edge, 0.0, 0.38]), 0.01)
    answer = tracker().track(seen(sheet(), finger))
    assert isinstance(answer, MarkerMiss) or max(off(answer, FACING, MIDDLE)) < 5.0


def test_cluster_pose_error_is_within_its_covariance() -> None:
    rotation = tilted([0.0, 1.0, 0.0], 40.0)
    frame = seen(*cube_at(rotation, MIDDLE))
    assert max(off(TagTracker(SMALL, CUBE, CONFIG).track(frame), rotation, MIDDLE)) < 4.0


def test_cluster_with_one_hidden_tag_is_found() -> None:
    # No edge along the pixels: there the renderer, which blurs after pixels, unlike a lens, is off by 0.015 px.
    rotation = tilted([0.2, 1.0, 0.3], 40.0)
    frame = seen(cube_at(rotation, MIDDLE)[0])
    assert max(off(TagTracker(SMALL, CUBE, CONFIG).track(frame), rotation, MIDDLE)) < 4.0


def test_eyes_without_a_common_tag_see_no_marker() -> None:
    one, other = cube_at(tilted([0.2, 1.0, 0.3], 40.0), MIDDLE)
    frame = StereoFrame(0.0, seen(one).left, seen(other).images[1])
    assert reason(TagTracker(SMALL, CUBE, CONFIG).track(frame)) is Reason.NO_MARKER


def test_a_tag_refused_by_one_eye_tells_why(monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = cube_at(tilted([0.2, 1.0, 0.3], 40.0), MIDDLE)
    right = seen(one, other).images[1].astype(np.float64)
    faded = slice(None, int(SMALL.project(np.array([one.x, other.x]))[:, 2].mean()))  # up to the other tag
    right[:, faded] = 128.0 + 0.2 * (right[:, faded] - 128.0)
    frame = StereoFrame(0.0, seen(one).left, right.astype(np.uint8))
    monkeypatch.setattr(EdgeSettings, "min_contrast", 60.0)  # less, and OpenCV does not find the tag
    assert reason(TagTracker(SMALL, CUBE, CONFIG).track(frame)) is Reason.LOW_CONTRAST


def test_more_tags_reduce_orientation_covariance() -> None:
    rotation = tilted([0.0, 1.0, 0.0], 40.0)
    sightings = []
    for corners in CUBE.corners.values():
        pixels = SMALL.project(corners @ rotation.T + MIDDLE)
        cov = 0.02**2 * np.eye(8)
        sightings.append([Sighting(corners, pixels[:, 2 * eye : 2 * eye + 2], cov, right=bool(eye)) for eye in (0, 1)])
    one, both = (
        PoseEstimator(SMALL, seen).refine(rotation, MIDDLE) for seen in (sightings[0], sightings[0] + sightings[1])
    )
    assert one is not None
    assert both is not None
    assert np.trace(both.cov[:3, :3]) < 0.7 * np.trace(one.cov[:3, :3])


def test_tags_contradicting_the_cluster_table_are_refused() -> None:
    wrong = TagBody.cluster(
        ClusterConfig(tags=(PLACED[0], PlacedTag(id=2, xyz=(0.03, 0.0, 0.0), rpy=PLACED[1].rpy))), CONFIG
    )
    frame = seen(*cube_at(tilted([0.0, 1.0, 0.0], 40.0), MIDDLE))
    assert reason(TagTracker(SMALL, wrong, CONFIG).track(frame)) in {Reason.REPROJECTION, Reason.SIZE_MISMATCH}


def test_images_of_another_size_are_refused() -> None:
    grey = np.zeros((100, 100, 3), np.uint8)
    with pytest.raises(SourceError, match="the calibration is for 320x240"):
        tracker().track(StereoFrame(0.0, grey, grey))


def test_a_cluster_without_tags_is_refused() -> None:
    with pytest.raises(ConfigError, match="has no tags"):
        tracker_of(SMALL, VisionConfig(marker="cluster"))


def test_a_cluster_with_one_tag_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match="has the tag 1 twice"):
        TagBody.cluster(ClusterConfig(tags=(PLACED[0], PLACED[0])), CONFIG)


def test_tag_number_beyond_dictionary_is_refused() -> None:
    with pytest.raises(ConfigError, match="no tag 999 in apriltag_36h11"):
        tracker(TagConfig(id=999))


@pytest.mark.parametrize(("marker", "kind"), [("ball", StereoTracker), ("tag", TagTracker)])
def test_tracker_type_follows_configured_marker(marker, kind) -> None:
    assert isinstance(tracker_of(SMALL, VisionConfig(marker=marker)), kind)


def test_an_aruco_tag_is_found_in_its_dictionary() -> None:
    config = TagConfig(dictionary="aruco_6x6_50", id=5, side_m=SIDE_M)
    printed = replace(sheet(5), dictionary=cv2.aruco.DICT_6X6_50)
    assert max(off(tracker(config).track(seen(printed)), FACING, MIDDLE)) < 4.0


def test_exact_pixels_give_exact_pose_from_rough_start() -> None:
    rng = np.random.default_rng(3)
    points, rotation = 0.05 * rng.normal(size=(8, 3)), Rotation.random(rng=rng).as_matrix()
    pixels = SMALL.project(points @ rotation.T + MIDDLE)
    cov = 0.01**2 * np.eye(16)
    sightings = [Sighting(points, pixels[:, 2 * eye : 2 * eye + 2], cov, right=bool(eye)) for eye in (0, 1)]
    rough = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix() @ rotation
    pose = PoseEstimator(SMALL, sightings).refine(rough, MIDDLE + 0.02)
    assert pose is not None
    assert pose.rotation == pytest.approx(rotation, abs=1e-8)
    assert pose.x == pytest.approx(MIDDLE, abs=1e-9)


def test_mirroring_a_pose_twice_restores_it() -> None:
    rotation = Rotation.random(rng=np.random.default_rng(4)).as_matrix()
    assert mirrored(mirrored(rotation, MIDDLE), MIDDLE) == pytest.approx(rotation, abs=1e-12)


def test_blurred_step_matches_light_on_square_pixels() -> None:
    shift = (np.arange(400) + 0.5) / 400.0
    places = np.linspace(-2.0, 2.0, 81)
    whole = np.floor(places[:, None] - shift)
    part = places[:, None] - shift - whole
    # Pixels whose centres are at whole numbers plus the shift see this share of a step at 0.
    left, right = (np.clip(0.5 + shift + whole + more, 0.0, 1.0) for more in (0.0, 1.0))
    seen = (left * (1.0 - part) + right * part).mean(axis=1)
    blur_px = 0.5  # of a pixel and the interpolation
    assert np.abs(blurred_step(places / blur_px, PIXEL_CUMULANT / blur_px**4) - seen).max() < 0.003
    tail = places <= -0.85
    gauss, ours = (float(np.sum(blurred_step(places[tail] / blur_px, c) - seen[tail])) for c in (0.0, -0.4))
    assert abs(ours) < 0.2 * abs(gauss)
