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


def test_following_gives_same_fixes_as_full_search():
    following, searching = StereoTracker(SMALL), StereoTracker(SMALL)
    for number, ball in enumerate(walk(10)):
        frame = stage(ball, t=number * FRAME_S, seed=number)
        searching.forget()
        followed, searched = following.track(frame), searching.track(frame)
        assert isinstance(followed, MarkerFix)
        assert isinstance(searched, MarkerFix)
        # Both start from a rough circle of their own and stop when it has settled.
        assert np.abs(np.array(followed.centres_px) - np.array(searched.centres_px)).max() < 0.01


def test_followed_ball_is_not_confused_with_distant_twin():
    tracker = tracker_that_saw(NEAR)
    assert sigmas_off(tracker.track(stage(NEAR, ELSEWHERE, t=FRAME_S)), NEAR) < FAR_SIGMAS


def test_nearby_mirror_copy_is_refused_after_ball_leaves():
    tracker = tracker_that_saw(NEAR)
    copy = Ball((0.06, 0.0, 1.0), rgb=(0.45, 0.04, 0.04))
    for number in range(1, 6):
        assert reason(tracker.track(stage(copy, t=number * FRAME_S))) is Reason.REFLECTION


def test_ball_receding_into_shade_is_followed():
    tracker = tracker_that_saw(NEAR)
    for number in range(1, 8):
        shade = 1.0 - 0.07 * number
        ball = Ball((0.05, 0.0, 0.8 + 0.04 * number), rgb=(0.85 * shade, 0.08 * shade, 0.08 * shade))
        assert sigmas_off(tracker.track(stage(ball, t=number * FRAME_S)), ball) < FAR_SIGMAS


def test_followed_ball_is_found_before_similarly_coloured_box():
    ball = Ball((0.05, 0.0, 1.4))
    box = Slab((0.05, -0.06), (0.13, 0.02), 1.4, (0.8, 0.2, 0.15))
    frame = stage(box, ball, t=FRAME_S)
    assert sigmas_off(tracker_that_saw(ball).track(frame), ball) < FAR_SIGMAS
    # By its colour alone the box and the ball are one patch.
    assert reason(StereoTracker(SMALL).track(frame)) is Reason.OCCLUDED


def test_same_coloured_box_at_predicted_place_is_refused():
    tracker = tracker_that_saw(NEAR)
    box = Slab((0.01, -0.04), (0.09, 0.04), 0.8, NEAR.rgb)
    assert reason(tracker.track(stage(box, t=FRAME_S))) is Reason.OCCLUDED


def test_prediction_beyond_view_hides_no_visible_ball():
    tracker = StereoTracker(SMALL)
    edge_m = 0.8 * SMALL.principal_point_px[0] / SMALL.focal_px
    for number in (3, 2):
        ball = Ball((edge_m - 0.05 * number, 0.0, 0.8))
        assert isinstance(tracker.track(stage(ball, t=(3 - number) * FRAME_S)), MarkerFix)
    assert sigmas_off(tracker.track(stage(NEAR, t=3 * FRAME_S)), NEAR) < FAR_SIGMAS
    assert reason(tracker.track(stage(t=4 * FRAME_S))) is Reason.NO_MARKER


def test_forgetting_tracker_searches_whole_images():
    tracker = tracker_that_saw(NEAR)
    tracker.forget()
    assert reason(tracker.track(stage(NEAR, ELSEWHERE, t=FRAME_S))) is Reason.AMBIGUOUS


def test_long_pause_triggers_full_search():
    tracker = tracker_that_saw(NEAR)
    assert reason(tracker.track(stage(NEAR, ELSEWHERE, t=0.6))) is Reason.AMBIGUOUS


def test_backward_time_step_triggers_full_search():
    tracker = tracker_that_saw(NEAR, t=9.0)
    assert reason(tracker.track(stage(NEAR, ELSEWHERE, t=8.9))) is Reason.AMBIGUOUS


def test_after_a_miss_the_whole_images_are_searched():
    tracker = tracker_that_saw(NEAR)
    assert reason(tracker.track(stage(t=FRAME_S))) is Reason.NO_MARKER
    assert reason(tracker.track(stage(NEAR, ELSEWHERE, t=2 * FRAME_S))) is Reason.AMBIGUOUS


def test_jumping_ball_is_found_in_same_frame():
    tracker = tracker_that_saw(NEAR)
    assert sigmas_off(tracker.track(stage(ELSEWHERE, t=FRAME_S)), ELSEWHERE) < FAR_SIGMAS


def test_ball_is_followed_at_new_place_after_jump():
    tracker = tracker_that_saw(NEAR)
    tracker.track(stage(ELSEWHERE, t=FRAME_S))
    assert sigmas_off(tracker.track(stage(NEAR, ELSEWHERE, t=2 * FRAME_S)), ELSEWHERE) < FAR_SIGMAS


def test_ball_reappearing_from_behind_hand_is_found_immediately():
    tracker = tracker_that_saw(NEAR)
    hand = Slab((-0.1, 0.0), (0.2, 0.2), 0.7)
    assert reason(tracker.track(stage(NEAR, hand, t=FRAME_S))) is Reason.OCCLUDED
    assert sigmas_off(tracker.track(stage(NEAR, t=2 * FRAME_S)), NEAR) < FAR_SIGMAS


def test_ball_leaving_image_is_at_border_then_gone():
    tracker = StereoTracker(SMALL)
    # 15 px a frame; the centre leaves the left image at the fourth.
    answers = [reason(tracker.track(stage(Ball((0.14 + 0.02 * n, 0.0, 0.8)), t=n * FRAME_S))) for n in range(6)]
    assert answers[0] is None
    assert Reason.AT_BORDER in answers
    assert answers[-1] is Reason.NO_MARKER


@pytest.mark.parametrize(("t", "said"), [(0.5, Reason.AMBIGUOUS), (1.2, None)])
def test_remaining_twin_ball_becomes_marker_after_one_second(t, said):
    tracker = StereoTracker(SMALL)
    tracker.track(stage(NEAR, ELSEWHERE))
    assert reason(tracker.track(stage(ELSEWHERE, t=t))) is said


def test_mirror_copy_of_unmeasured_ball_is_a_reflection():
    tracker = StereoTracker(SMALL)
    hand = Slab((NEAR.x[0] + 0.7 * NEAR.radius_m, -0.1), (0.2, 0.1), NEAR.x[2])
    mirrored = Ball((0.1, -0.05, 1.3), rgb=(0.45, 0.04, 0.04))
    assert reason(tracker.track(stage(NEAR, hand))) is Reason.OCCLUDED
    assert reason(tracker.track(stage(mirrored, t=FRAME_S))) is Reason.REFLECTION


def test_followed_ball_stays_marker_after_rival_in_view():
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


def test_tracked_camera_answers_every_frame_with_its_time():
    with TrackedCamera(Camera(stage(NEAR, t=1.0), stage(t=1.1)), StereoTracker(SMALL)) as source:
        found, lost = source.read(0.1), source.read(0.1)
    assert found is not None
    assert lost is not None
    assert (found.t, lost.t) == (1.0, 1.1)


def test_tracked_camera_shows_newest_frame_with_detections():
    annotator = Annotator(SMALL, VisionConfig())
    with TrackedCamera(Camera(stage(NEAR)), StereoTracker(SMALL), annotator) as source:
        assert source.picture() is None
        seen = source.read(0.1)
        jpeg = source.picture()
    assert seen is not None
    assert jpeg is not None
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    annotated = annotator.annotated(stage(NEAR), seen)
    assert picture.shape == annotated.shape
    assert np.abs(picture.astype(float) - annotated).mean() < 4.0
    assert np.abs(np.hstack(stage(NEAR).images).astype(float) - annotated).mean() > 6.0


def test_tracked_camera_returns_none_without_frame():
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
