"""The ball's size, learned during tracking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from ball_renderer import SMALL, in_eyes
from scenes import RADIUS_M, Ball, reason, stage

from bodyschema.interfaces.records import MarkerFix, Reason
from bodyschema.vision.ball.blob import Disc
from bodyschema.vision.ball.size import BallSize
from bodyschema.vision.ball.sphere import Pinhole
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.triangulate import Location, locate

X = np.array([0.02, 0.01, 0.8])
CENTRE_SIGMA_PX = 0.01
FRAME_S = 1 / 30


def located(smaller: float = 0.0, pulled_px: float = 0.0, radius_m: float = RADIUS_M) -> Location:
    """Return the location of a ball whose discs are both smaller by this share and shifted right by `pulled_px`."""
    eye = Pinhole(SMALL.focal_px, SMALL.principal_point_px)
    discs = []
    for x_eye in in_eyes(X, SMALL):
        outline = eye.outline(x_eye, RADIUS_M)
        assert outline is not None
        centre_px = outline.centre_px + np.array([0.0, pulled_px])
        discs.append(Disc(centre_px, (1.0 - smaller) * outline.radius_px, CENTRE_SIGMA_PX**2 * np.eye(2), 0.01, 100.0))
    found = locate(SMALL, radius_m, *discs)
    assert found is not None
    return found


def size_after(fixes: int, radius_m: float = RADIUS_M) -> BallSize:
    size = BallSize(SMALL)
    for _ in range(fixes):
        size.learn(located(radius_m=radius_m))
    return size


def test_matching_size_leaves_covariance_unchanged() -> None:
    found = located()
    assert size_after(5).with_size_error(found) is found


def test_size_mismatch_in_both_eyes_inflates_centre_covariance() -> None:
    found = located(smaller=0.04, pulled_px=0.5)
    with_size_error = size_after(5).with_size_error(found)
    off = with_size_error.x - X
    assert off @ np.linalg.solve(found.cov, off) > 20.0**2
    assert off @ np.linalg.solve(with_size_error.cov, off) < 2.0**2


def test_first_fix_is_checked_against_configured_radius() -> None:
    found = located(smaller=0.1, pulled_px=0.5)
    assert BallSize(SMALL).with_size_error(found).cov[1, 1] > 100.0 * found.cov[1, 1]


def test_a_radius_that_was_measured_badly_is_learnt() -> None:
    wrong_m = 1.08 * RADIUS_M
    found = located(radius_m=wrong_m)
    assert BallSize(SMALL).with_size_error(found) is not found
    assert size_after(3, wrong_m).with_size_error(found) is found


def test_outlier_size_does_not_disturb_learnt_size() -> None:
    size = size_after(10)
    size.learn(located(smaller=0.2))
    assert size.with_size_error(located()).cov[2, 2] == located().cov[2, 2]


def test_swapped_in_other_size_is_refused_marker_refound() -> None:
    marker, tracker = Ball((0.02, 0.01, 0.8)), StereoTracker(SMALL)
    other = replace(marker, radius_m=0.85 * RADIUS_M)
    for number in range(6):
        assert isinstance(tracker.track(stage(marker, t=number * FRAME_S, seed=number)), MarkerFix)
    assert reason(tracker.track(stage(other, t=6 * FRAME_S))) is Reason.SIZE_MISMATCH
    assert isinstance(tracker.track(stage(marker, t=7 * FRAME_S)), MarkerFix)


def test_tracker_accepts_another_ball_size_after_forgetting() -> None:
    marker, tracker = Ball((0.02, 0.01, 0.8)), StereoTracker(SMALL)
    for number in range(6):
        tracker.track(stage(marker, t=number * FRAME_S, seed=number))
    tracker.forget()
    assert isinstance(tracker.track(stage(replace(marker, radius_m=0.85 * RADIUS_M), t=0.2)), MarkerFix)
