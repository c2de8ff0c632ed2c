from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_renderer import SMALL, VGA, Look, clutter, in_eyes, paint_ball, random_light, take
from hand import paint_fingers
from scenes import RADIUS_M, Ball, Slab, place, reason, sigmas_off, stage

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.records import MarkerFix, Reason, StereoFrame
from bodyschema.vision.ball.blob import Disc, Region, find_patches, measure
from bodyschema.vision.ball.colour import gate_of
from bodyschema.vision.ball.match import StereoMatcher
from bodyschema.vision.ball.sphere import Pinhole
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.triangulate import Location

BALL = Ball((0.02, 0.01, 0.8))
FAR_SIGMAS = 5.0


def answer(*things, config=None, **staging):
    return StereoTracker(SMALL, config).track(stage(*things, **staging))


def at_pixel(u: float, v: float, z: float = 0.8) -> Ball:
    """Return a ball whose centre the left camera sees at (u, v) [px]."""
    cx, cy = SMALL.principal_point_px
    return Ball(((u - cx) * z / SMALL.focal_px, (v - cy) * z / SMALL.focal_px, z))


def seen_discs(ball: Ball, level: float) -> list[Disc]:
    """Return the discs of a ball in the left and in the right image."""
    eye = Pinhole(SMALL.focal_px, SMALL.principal_point_px)
    outlines = [eye.outline(x_eye, ball.radius_m) for x_eye in in_eyes(np.array(ball.x), SMALL)]
    return [Disc(one.centre_px, one.radius_px, 1e-4 * np.eye(2), 0.01, level) for one in outlines if one is not None]


def test_a_ball_before_a_wall_is_found():
    assert sigmas_off(answer(BALL), BALL) < FAR_SIGMAS


@pytest.mark.parametrize("side_px", [9, 10, 11, 12, 14, 18])
def test_square_of_ball_hue_is_not_round(side_px):
    rng = np.random.default_rng(side_px)
    images = []
    for u in (150, 110):
        picture = np.full((240, 320, 3), 0.3)
        picture[100 : 100 + side_px, u : u + side_px] = (0.85, 0.1, 0.1)
        images.append(take(picture, Look(blur_px=0.9, noise_sd=1.5), rng))
    radius_m = 0.06 * side_px / 2 / 40.0  # a ball of this size would fit the depth
    found = StereoTracker(SMALL, VisionConfig(radius_m=radius_m)).track(StereoFrame(0.0, *images))
    assert reason(found) is Reason.NOT_ROUND


def test_no_ball_is_no_marker():
    assert reason(answer()) is Reason.NO_MARKER


def test_a_ball_of_another_colour_is_no_marker():
    assert reason(answer(replace(BALL, rgb=(0.1, 0.2, 0.8)))) is Reason.NO_MARKER


def test_ball_too_far_to_measure_is_no_marker():
    # Radius 2.4 px: 18 pixels.
    assert reason(answer(Ball((0.1, 0.0, 5.0)))) is Reason.NO_MARKER


# The ball's radius is 15 px, the image 320x240; in the right image it is 45 px farther left.
@pytest.mark.parametrize(
    ("u", "v"), [(200, 8), (200, 16), (200, 230), (310, 120), (302, 120), (62, 120), (50, 120), (200, -5)]
)
def test_ball_touching_either_image_border_is_at_border(u, v):
    assert reason(answer(at_pixel(u, v))) is Reason.AT_BORDER


@pytest.mark.parametrize(("u", "v"), [(200, 21), (200, 218), (298, 120), (67, 120)])
def test_ball_just_clear_of_borders_is_found(u, v):
    ball = at_pixel(u, v)
    assert sigmas_off(answer(ball), ball) < FAR_SIGMAS


@pytest.mark.parametrize(
    "slab",
    [
        pytest.param(Slab((0.016, -0.1), (0.024, 0.1), 0.7), id="bar down the middle"),
        pytest.param(Slab((-0.1, 0.006), (0.1, 0.013), 0.7), id="bar across"),
        pytest.param(Slab((-0.1, 0.012), (0.1, 0.1), 0.75), id="hand over the lower half"),
        pytest.param(Slab((0.025, -0.1), (0.1, 0.1), 0.78), id="board over the right third"),
        pytest.param(Slab((-0.1, -0.1), (0.012, 0.1), 0.75), id="board over the left third"),
    ],
)
def test_a_ball_partly_behind_something_is_occluded(slab):
    assert reason(answer(BALL, slab)) is Reason.OCCLUDED


def test_ball_half_hidden_from_one_eye_is_occluded():
    # At half the depth a board that covers half of the ball in the left image is beside it in the right one.
    assert reason(answer(BALL, Slab((0.012, -0.1), (0.03, 0.1), 0.4))) is Reason.OCCLUDED


def test_a_ball_wholly_hidden_is_no_marker():
    assert reason(answer(BALL, Slab((-0.1, -0.1), (0.1, 0.1), 0.7))) is Reason.NO_MARKER


@pytest.mark.parametrize("covered", [0.02, 0.06, 0.10, 0.15, 0.2, 0.3, 0.4])
def test_partly_covered_ball_is_accurate_or_occluded(covered):
    limb = BALL.x[0] + BALL.radius_m * (1 - 2 * covered)
    found = answer(BALL, Slab((limb, -0.1), (0.2, 0.1), BALL.x[2]))
    assert reason(found) is Reason.OCCLUDED or sigmas_off(found, BALL) < FAR_SIGMAS


def test_arm_touching_ball_outline_does_not_pull_centre():
    beside = Slab((BALL.x[0] + 1.02 * BALL.radius_m, -0.1), (0.2, 0.1), BALL.x[2], rgb=(0.15, 0.15, 0.2))
    assert sigmas_off(answer(beside, BALL), BALL) < FAR_SIGMAS


@pytest.mark.soak
def test_fingertips_over_small_ball_do_not_pass():
    rng = np.random.default_rng(3)
    tracker = StereoTracker(SMALL)
    passed = 0
    for _ in range(60):
        tracker.forget()
        look = random_light(rng, Look(noise_sd=1.5, shot=0.03, samples=4))
        x, turn = place(SMALL, float(rng.uniform(7.0, 9.0)), rng), float(rng.uniform(0.0, 2.0 * np.pi))
        images = []
        for x_eye in in_eyes(x, SMALL):
            ball = paint_ball(clutter(rng, SMALL.image_size_px), x_eye, RADIUS_M, look, SMALL)
            images.append(take(paint_fingers(ball, x_eye, RADIUS_M, turn, 0.9, SMALL), look, rng))
        passed += isinstance(tracker.track(StereoFrame(0.0, *images)), MarkerFix)
    # 8 of 180 pass if each image is checked by itself.
    assert passed <= 1


def test_limb_is_occluded_only_if_uneven_in_both():
    matcher = StereoMatcher(SMALL, VisionConfig())
    left, right = (replace(disc, roughness=6.0) for disc in seen_discs(BALL, level=120.0))
    assert matcher.match([left], [right]) is Reason.OCCLUDED
    assert isinstance(matcher.match([left], [replace(right, roughness=1.0)]), Location)


def test_slightly_unround_ball_is_found_without_noise():
    # OpenCV draws a circle as a polygon, the same in both images.
    images = []
    for u in (160, 100):
        image = np.full((240, 320, 3), 128, np.uint8)
        cv2.circle(image, (16 * u, 16 * 120), 16 * 12, (30, 30, 220), -1, cv2.LINE_AA, 4)
        images.append(cv2.GaussianBlur(image, (5, 5), 0.7))
    calibration = StereoCalibration(300.0, (159.5, 119.5), 0.1, (320, 240))
    assert isinstance(StereoTracker(calibration).track(StereoFrame(0.0, *images)), MarkerFix)


def test_a_red_box_is_no_ball():
    assert reason(answer(Slab((-0.02, -0.1), (0.05, 0.0), 0.8, rgb=(0.7, 0.1, 0.1)))) is Reason.OCCLUDED


def test_ball_before_red_box_is_never_misplaced():
    box = Slab((0.0, -0.05), (0.15, 0.1), 0.9, rgb=(0.45, 0.12, 0.1))
    found = answer(box, BALL)
    assert reason(found) is Reason.OCCLUDED or sigmas_off(found, BALL) < FAR_SIGMAS


def test_a_ball_beside_a_red_box_is_found():
    box = Slab((-0.11, -0.05), (-0.05, 0.1), 0.9, rgb=(0.7, 0.1, 0.1))
    assert sigmas_off(answer(box, BALL), BALL) < FAR_SIGMAS


@pytest.mark.parametrize("other", [(0.1, 0.01, 0.8), (0.02, 0.1, 0.8), (0.08, -0.06, 0.7)])
def test_two_balls_are_ambiguous(other):
    assert reason(answer(BALL, Ball(other))) is Reason.AMBIGUOUS


# The second of two balls: the border of the left image cuts it at the top, that of the right one at the left, too.
@pytest.mark.parametrize(("u", "v"), [(200, 4), (120, -3), (55, 10)])
def test_second_ball_partly_out_of_view_is_ambiguous(u, v):
    assert reason(answer(at_pixel(220, 150), at_pixel(u, v))) is Reason.AMBIGUOUS


def test_red_board_at_border_is_no_second_ball():
    board = Slab((-0.3, -0.3), (-0.09, -0.05), 0.9, rgb=(0.7, 0.1, 0.1))
    assert sigmas_off(answer(board, BALL), BALL) < FAR_SIGMAS


def test_second_ball_of_another_size_is_ignored():
    assert sigmas_off(answer(BALL, Ball((0.08, -0.06, 0.8), radius_m=0.012)), BALL) < FAR_SIGMAS


def test_larger_distant_ball_fails_size_check():
    # It looks just as large as the marker at half the distance.
    assert reason(answer(Ball((0.05, 0.0, 1.6), radius_m=0.04))) is Reason.SIZE_MISMATCH


def test_smaller_near_ball_fails_size_check():
    assert reason(answer(Ball((0.02, 0.0, 0.4), radius_m=0.01))) is Reason.SIZE_MISMATCH


def test_wrong_configured_radius_fails_size_check():
    assert reason(answer(BALL, config=VisionConfig(radius_m=0.03))) is Reason.SIZE_MISMATCH


def test_different_ball_sizes_between_eyes_fail_size_check():
    left, right = stage(BALL), stage(replace(BALL, radius_m=0.026))
    # Within the depth limit, so that only the comparison of the two images can detect it.
    tracker = StereoTracker(SMALL, VisionConfig(radius_m=0.023))
    assert reason(tracker.track(StereoFrame(0.0, left.left, right.right))) is Reason.SIZE_MISMATCH


@pytest.mark.parametrize("rows", [-8, -2, 2, 8])
def test_eyes_whose_rows_disagree_fail_the_epipolar_check(rows):
    frame = stage(BALL)
    tilted = StereoFrame(0.0, frame.left, np.roll(frame.right, rows, axis=0))
    assert reason(StereoTracker(SMALL).track(tilted)) is Reason.EPIPOLAR


def test_interchanged_eyes_fail_the_epipolar_check():
    frame = stage(BALL)
    assert reason(StereoTracker(SMALL).track(StereoFrame(0.0, frame.right, frame.left))) is Reason.EPIPOLAR


@pytest.mark.parametrize("level", [0, 255])
def test_a_dead_camera_is_no_marker(level):
    frame = stage(BALL)
    dead = np.full_like(frame.right, level)
    assert reason(StereoTracker(SMALL).track(StereoFrame(0.0, frame.left, dead))) is Reason.NO_MARKER


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 5))])
def test_an_image_of_noise_gives_a_reason(seed):
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (2, 240, 320, 3), dtype=np.uint8)
    assert isinstance(reason(StereoTracker(SMALL).track(StereoFrame(0.0, *images))), Reason)


def test_an_all_red_image_gives_a_reason():
    red = np.zeros((240, 320, 3), np.uint8)
    red[..., 2] = 200
    assert reason(StereoTracker(SMALL).track(StereoFrame(0.0, red, red))) is Reason.AT_BORDER


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (np.zeros((240, 320), np.uint8), "320x240 pixels of grey"),
        (np.zeros((480, 640, 3), np.uint8), "640x480 pixels of 3 channels"),
        (np.zeros((240, 320, 3), np.float32), r"320x240 pixels of 3 channels \(float32\)"),
        (np.zeros(7, np.uint8), "an array of shape"),
    ],
)
def test_image_not_fitting_calibration_is_refused_naming_eye(image, said):
    frame = StereoFrame(0.0, stage(BALL).left, image)
    with pytest.raises(SourceError, match=f"the right image is {said}"):
        StereoTracker(SMALL).track(frame)


def test_partly_over_exposed_ball_is_found():
    found = answer(BALL, look=Look(specular=1.5, shininess=12.0, noise_sd=2.0))
    assert sigmas_off(found, BALL) < FAR_SIGMAS


def test_glossy_ball_is_found_before_white_wall():
    # A fifth of the ball is white; with the wall's share of its bounding box it would be too much.
    look = Look(specular=5.0, shininess=4.0, noise_sd=2.0)
    wall = Slab((-9.0, -9.0), (9.0, 9.0), 5.0, rgb=(3.0, 3.0, 3.0))
    for things in ((BALL,), (wall, BALL)):
        assert sigmas_off(answer(*things, look=look), BALL) < FAR_SIGMAS


def test_largest_ball_within_both_images_is_found():
    ball = Ball((0.06, 0.0, 0.2))
    tracker = StereoTracker(VGA)
    assert sigmas_off(tracker.track(stage(ball, calibration=VGA)), ball) < FAR_SIGMAS


def test_a_ball_that_is_mostly_white_is_saturated():
    flooded = Look(specular=30.0, shininess=1.5, noise_sd=2.0)
    assert reason(answer(BALL, look=flooded)) in (Reason.SATURATED, Reason.NO_MARKER)


def test_dimmer_distant_copy_is_no_second_marker():
    mirrored = Ball((-0.02, -0.03, 1.0), rgb=(0.45, 0.04, 0.04))
    assert sigmas_off(answer(BALL, mirrored), BALL) < FAR_SIGMAS


def test_disc_measured_in_one_eye_rivals_disc_above():
    matcher = StereoMatcher(SMALL, VisionConfig())
    copy = seen_discs(Ball((0.0, -0.06, 1.6)), level=60.0)
    found = matcher.match(*([disc] for disc in copy))
    assert isinstance(found, Location)
    # The marker's left image is right below the copy's.
    marker = seen_discs(Ball((0.0, 0.0, 0.8)), level=120.0)
    mask = np.zeros((240, 320), np.uint8)
    u, v = np.rint(marker[0].centre_px).astype(int)
    cv2.circle(mask, (int(u), int(v)), round(marker[0].radius_px), 255, -1)
    assert matcher.may_be_second_marker(marker[1], [copy[0]], mask, found, in_left=False)


def test_copy_beside_unmeasured_marker_is_a_reflection():
    matcher = StereoMatcher(SMALL, VisionConfig())
    mirrored = seen_discs(Ball((-0.02, -0.03, 1.0)), level=80.0)
    marker = seen_discs(BALL, level=120.0)
    found = matcher.match(*([disc] for disc in mirrored))
    assert isinstance(found, Location)
    both_eyes = ([one, other] for one, other in zip(mirrored, marker, strict=True))
    assert matcher.ambiguity(found, *both_eyes) is Reason.REFLECTION


def test_brightness_from_brighter_part_matches_whole_ball():
    image, config, gate = stage(BALL).left, VisionConfig(), gate_of(VisionConfig())
    eye = Pinhole(SMALL.focal_px, SMALL.principal_point_px)
    (patch,) = find_patches(image, Region(0, 0, *SMALL.image_size_px), gate)
    # Light falls from above on the left.
    part = replace(patch, box=replace(patch.box, right=patch.box.right - 12, bottom=patch.box.bottom - 12))
    whole, again = (measure(image, one, eye, gate, config) for one in (patch, part))
    assert isinstance(whole, Disc)
    assert isinstance(again, Disc)
    assert again.level == pytest.approx(whole.level, rel=0.02)


def test_mirror_copy_of_hidden_ball_is_a_reflection():
    tracker = StereoTracker(SMALL)
    tracker.track(stage(BALL))
    mirrored = Ball((-0.1, -0.1, 1.3), rgb=(0.45, 0.04, 0.04))
    assert reason(tracker.track(stage(mirrored, t=0.1))) is Reason.REFLECTION


def test_twin_out_of_reach_has_implausible_speed():
    tracker = StereoTracker(SMALL)
    tracker.track(stage(BALL))
    twin = Ball((-0.1, -0.1, 1.3))
    assert reason(tracker.track(stage(twin, t=0.1))) is Reason.IMPLAUSIBLE_SPEED


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (Ball((0.02, -0.05, 1.1), rgb=(0.45, 0.04, 0.04)), Reason.REFLECTION),
        (Ball((0.02, -0.05, 1.1)), Reason.IMPLAUSIBLE_SPEED),
    ],
)
def test_stationary_impostor_is_rejected_in_every_frame(other, said):
    tracker = StereoTracker(SMALL)
    tracker.track(stage(BALL))
    # 0.3 m away, which the marker itself might go in 0.1 s.
    assert [reason(tracker.track(stage(other, t=number / 30))) for number in range(1, 7)] == [said] * 6


def test_marker_may_be_anywhere_one_second_after_fix():
    tracker = StereoTracker(SMALL)
    tracker.track(stage(BALL))
    elsewhere = Ball((-0.1, -0.1, 1.3))
    assert sigmas_off(tracker.track(stage(elsewhere, t=1.2)), elsewhere) < FAR_SIGMAS


def test_size_disagreement_between_eyes_inflates_sigma():
    matcher = StereoMatcher(SMALL, VisionConfig())
    agreeing = seen_discs(BALL, level=120.0)
    apart = [agreeing[0], replace(agreeing[1], radius_px=1.02 * agreeing[1].radius_px)]
    found = [matcher.match([left], [right]) for left, right in (agreeing, apart)]
    sigmas = [np.sqrt(np.diag(one.cov)) for one in found if isinstance(one, Location)]
    assert (sigmas[1] > 2.0 * sigmas[0]).all()


def test_row_difference_within_two_sigmas_keeps_covariance():
    matcher = StereoMatcher(SMALL, VisionConfig())
    left, right = seen_discs(BALL, level=120.0)
    sigma_px = float(np.sqrt(left.cov_px[1, 1] + right.cov_px[1, 1]))
    lower = replace(right, centre_px=right.centre_px + np.array([0.0, 1.9 * sigma_px]))
    same, other = (matcher.match([left], [one]) for one in (right, lower))
    assert isinstance(same, Location)
    assert isinstance(other, Location)
    assert np.diag(other.cov) == pytest.approx(np.diag(same.cov), rel=0.01)
