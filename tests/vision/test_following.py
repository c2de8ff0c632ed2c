from __future__ import annotations

import cv2
import numpy as np
import pytest
from ball_renderer import SMALL
from scenes import Ball, Slab, reason, sigmas_off, stage

from bodyschema.interfaces.errors import SourceLost
from bodyschema.interfaces.records import MarkerFix, Reason
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.cameras.annotate import Annotator
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tracked_camera import TrackedCamera

FRAME_S = 1 / 30
FAR_SIGMAS = 5.0
NEAR = Ball((0.05, 0.0, 0.8))
ELSEWHERE = Ball((0.02, 0.1, 0.8))


def tracker_that_saw(ball: Ball, t: float = 0.0) -> StereoTracker:
    tracker = StereoTracker(SMALL)
    assert isinstance(tracker.track(stage(ball, t=t)), MarkerFix)
    return tracker


def walk(frames: int) -> list[Ball]:
    """Return a ball that moves to and fro at up to 0.6 m/s, 14 px per frame."""
    phase = 2 * np.pi * np.arange(frames) / 20
    return [Ball((0.05 + 0.06 * np.sin(p), 0.06 * np.cos(p), 0.8 + 0.1 * np.sin(2 * p))) for p in phase.tolist()]


def test_a_moving_ball_is_followed():
    tracker = StereoTracker(SMALL)
    for number, ball in enumerate(walk(20)):
        assert sigmas_off(tracker.track(stage(ball, t=number * FRAME_S, seed=number)), ball) < FAR_SIGMAS


def test_following_gives_the_same_fixes_as_searching_the_whole_images():
    following, searching = StereoTracker(SMALL), StereoTracker(SMALL)
    for number, ball in enumerate(walk(10)):
        frame = stage(ball, t=number * FRAME_S, seed=number)
        searching.forget()
        followed, searched = following.track(frame), searching.track(frame)
        assert isinstance(followed, MarkerFix)
        assert isinstance(searched, MarkerFix)
        # Both start from a rough circle of their own and stop when it has settled.
        assert np.abs(np.array(followed.centres_px) - np.array(searched.centres_px)).max() < 0.01


def test_a_followed_ball_is_not_confused_with_another_one_farther_off():
    tracker = tracker_that_saw(NEAR)
    assert sigmas_off(tracker.track(stage(NEAR, ELSEWHERE, t=FRAME_S)), NEAR) < FAR_SIGMAS


def test_a_copy_in_a_mirror_is_refused_however_near_when_the_ball_has_gone():
    tracker = tracker_that_saw(NEAR)
    copy = Ball((0.06, 0.0, 1.0), rgb=(0.45, 0.04, 0.04))
    for number in range(1, 6):
        assert reason(tracker.track(stage(copy, t=number * FRAME_S))) is Reason.REFLECTION


def test_a_ball_that_goes_away_into_the_shade_is_followed():
    tracker = tracker_that_saw(NEAR)
    for number in range(1, 8):
        shade = 1.0 - 0.07 * number
        ball = Ball((0.05, 0.0, 0.8 + 0.04 * number), rgb=(0.85 * shade, 0.08 * shade, 0.08 * shade))
        assert sigmas_off(tracker.track(stage(ball, t=number * FRAME_S)), ball) < FAR_SIGMAS


def test_a_followed_ball_is_found_before_a_box_of_nearly_its_colour():
    ball = Ball((0.05, 0.0, 1.4))
    box = Slab((0.05, -0.06), (0.13, 0.02), 1.4, (0.8, 0.2, 0.15))
    frame = stage(box, ball, t=FRAME_S)
    assert sigmas_off(tracker_that_saw(ball).track(frame), ball) < FAR_SIGMAS
    # By its colour alone the box and the ball are one patch.
    assert reason(StereoTracker(SMALL).track(frame)) is Reason.OCCLUDED


def test_a_box_of_the_ball_s_colour_where_the_ball_was_expected_is_no_ball():
    tracker = tracker_that_saw(NEAR)
    box = Slab((0.01, -0.04), (0.09, 0.04), 0.8, NEAR.rgb)
    assert reason(tracker.track(stage(box, t=FRAME_S))) is Reason.OCCLUDED


def test_a_ball_that_is_expected_out_of_view_is_missed_with_a_reason():
    tracker = StereoTracker(SMALL)
    edge_m = 0.8 * SMALL.principal_point_px[0] / SMALL.focal_px
    for number in (3, 2):
        ball = Ball((edge_m - 0.05 * number, 0.0, 0.8))
        assert isinstance(tracker.track(stage(ball, t=(3 - number) * FRAME_S)), MarkerFix)
    assert reason(tracker.track(stage(NEAR, t=3 * FRAME_S))) is not Reason.NO_MARKER
    assert reason(tracker.track(stage(t=4 * FRAME_S))) is Reason.NO_MARKER


def test_a_tracker_told_to_forget_searches_the_whole_images():
    tracker = tracker_that_saw(NEAR)
    tracker.forget()
    assert reason(tracker.track(stage(NEAR, ELSEWHERE, t=FRAME_S))) is Reason.AMBIGUOUS


def test_after_a_long_pause_the_whole_images_are_searched():
    tracker = tracker_that_saw(NEAR)
    assert reason(tracker.track(stage(NEAR, ELSEWHERE, t=0.6))) is Reason.AMBIGUOUS


def test_time_that_steps_back_makes_the_whole_images_be_searched():
    tracker = tracker_that_saw(NEAR, t=9.0)
    assert reason(tracker.track(stage(NEAR, ELSEWHERE, t=8.9))) is Reason.AMBIGUOUS


def test_after_a_miss_the_whole_images_are_searched():
    tracker = tracker_that_saw(NEAR)
    assert reason(tracker.track(stage(t=FRAME_S))) is Reason.NO_MARKER
    assert reason(tracker.track(stage(NEAR, ELSEWHERE, t=2 * FRAME_S))) is Reason.AMBIGUOUS


def test_a_ball_that_jumps_is_found_in_the_same_frame():
    tracker = tracker_that_saw(NEAR)
    assert sigmas_off(tracker.track(stage(ELSEWHERE, t=FRAME_S)), ELSEWHERE) < FAR_SIGMAS


def test_after_a_jump_the_ball_is_followed_at_its_new_place():
    tracker = tracker_that_saw(NEAR)
    tracker.track(stage(ELSEWHERE, t=FRAME_S))
    assert sigmas_off(tracker.track(stage(NEAR, ELSEWHERE, t=2 * FRAME_S)), ELSEWHERE) < FAR_SIGMAS


def test_a_ball_that_comes_out_from_behind_a_hand_is_found_at_once():
    tracker = tracker_that_saw(NEAR)
    hand = Slab((-0.1, 0.0), (0.2, 0.2), 0.7)
    assert reason(tracker.track(stage(NEAR, hand, t=FRAME_S))) is Reason.OCCLUDED
    assert sigmas_off(tracker.track(stage(NEAR, t=2 * FRAME_S)), NEAR) < FAR_SIGMAS


def test_a_ball_followed_out_of_the_image_is_at_border_then_gone():
    tracker = StereoTracker(SMALL)
    # 15 px a frame; the centre leaves the left image at the fourth.
    answers = [reason(tracker.track(stage(Ball((0.14 + 0.02 * n, 0.0, 0.8)), t=n * FRAME_S))) for n in range(6)]
    assert answers[0] is None
    assert Reason.AT_BORDER in answers
    assert answers[-1] is Reason.NO_MARKER


@pytest.mark.parametrize(("t", "said"), [(0.5, Reason.AMBIGUOUS), (1.2, None)])
def test_of_two_balls_alike_the_one_that_is_left_is_the_marker_after_a_second(t, said):
    tracker = StereoTracker(SMALL)
    tracker.track(stage(NEAR, ELSEWHERE))
    assert reason(tracker.track(stage(ELSEWHERE, t=t))) is said


def test_the_mirrored_copy_of_a_ball_that_was_in_view_but_not_measured_is_a_reflection():
    tracker = StereoTracker(SMALL)
    hand = Slab((NEAR.x[0] + 0.7 * NEAR.radius_m, -0.1), (0.2, 0.1), NEAR.x[2])
    mirrored = Ball((0.1, -0.05, 1.3), rgb=(0.45, 0.04, 0.04))
    assert reason(tracker.track(stage(NEAR, hand))) is Reason.OCCLUDED
    assert reason(tracker.track(stage(mirrored, t=FRAME_S))) is Reason.REFLECTION


def test_a_followed_ball_stays_the_marker_though_another_one_was_in_view_beside_it():
    tracker = tracker_that_saw(NEAR)
    tracker.track(stage(t=FRAME_S))
    tracker.track(stage(NEAR, ELSEWHERE, t=2 * FRAME_S))
    assert sigmas_off(tracker.track(stage(NEAR, t=3 * FRAME_S)), NEAR) < FAR_SIGMAS


class Camera:
    """A camera that returns given frames, one per read."""

    calibration = SMALL

    def __init__(self, *frames):
        self.frames, self.entered = list(frames), 0

    def __enter__(self):
        self.entered += 1
        return self

    def __exit__(self, kind=None, error=None, trace=None):
        self.entered -= 1

    def read(self, timeout_s):
        frame = self.frames.pop(0)
        if isinstance(frame, Exception):
            raise frame
        return frame


def test_a_tracked_camera_answers_every_frame_with_its_time():
    with TrackedCamera(Camera(stage(NEAR, t=1.0), stage(t=1.1)), StereoTracker(SMALL)) as source:
        found, lost = source.read(0.1), source.read(0.1)
    assert found is not None
    assert lost is not None
    assert (found.t, lost.t) == (1.0, 1.1)


def test_a_tracked_camera_shows_its_newest_frame_with_detections():
    annotator = Annotator(SMALL, VisionConfig())
    with TrackedCamera(Camera(stage(NEAR)), StereoTracker(SMALL), annotator) as source:
        assert source.picture() is None
        seen = source.read(0.1)
        jpeg = source.picture()
    assert seen is not None
    assert jpeg is not None
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    drawn = annotator.drawn(stage(NEAR), seen)
    assert picture.shape == drawn.shape
    assert np.abs(picture.astype(float) - drawn).mean() < 4.0
    assert np.abs(np.hstack(stage(NEAR).images).astype(float) - drawn).mean() > 6.0


def test_a_tracked_camera_has_nothing_while_no_frame_comes():
    with TrackedCamera(Camera(None), StereoTracker(SMALL)) as source:
        assert source.read(0.1) is None


def test_a_camera_opened_again_is_searched_from_scratch():
    camera = Camera(stage(NEAR, t=1.0), SourceLost("unplugged"), stage(NEAR, ELSEWHERE, t=1.0 + FRAME_S))
    source = TrackedCamera(camera, StereoTracker(SMALL))
    with source:
        source.read(0.1)
        with pytest.raises(SourceLost):
            source.read(0.1)
    assert camera.entered == 0
    with source:
        assert reason(source.read(0.1)) is Reason.AMBIGUOUS
