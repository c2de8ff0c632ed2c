"""Lenses that refocus: named by the camera's own controls, and by the views of a board."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_renderer import Photographer, Printed, Taken, TrueLens, poses, webcams
from fake_capture import FakeCapture
from shown_board import BOARD, SIZE, corner_views, view_of

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.calibration.calibrate import CalibrationRequest, calibrate, fit
from bodyschema.vision.calibration.refocus import focal_spread
from bodyschema.vision.calibration.view import EYES, ONE_EYE, Eye, View
from bodyschema.vision.cameras.v4l2.controls import FocusWatch
from bodyschema.vision.rig.stereo_rig import CalibrationError

# Corners of a board that is not printed as it says: the rows are apart by 0.5 % more at its right.
SHEARED = BOARD.corners_m * (1.0 + 0.005 * BOARD.corners_m[:, :1] / BOARD.corners_m[:, 0].max() * (0.0, 1.0, 0.0))


def complaints(*focus: float, autofocus: float = 0.0) -> list[str]:
    """Return the complaints about a camera whose focus is at these positions, a second each."""
    capture, watch = FakeCapture(), FocusWatch("left camera")
    capture.set(cv2.CAP_PROP_AUTOFOCUS, autofocus)
    for second, position in enumerate(focus):
        capture.set(cv2.CAP_PROP_FOCUS, position)
        watch.look(capture, float(second))
    return list(watch.complaints())


def test_an_autofocus_is_named() -> None:
    (said,) = complaints(30.0, 30.0, autofocus=1.0)
    assert said.startswith("the left camera's autofocus is on: ")


def test_a_lens_that_moved_is_named() -> None:
    (said,) = complaints(30.0, 45.0, 30.0)
    assert said.startswith("the left camera's lens moved, its focus from 30 to 45: ")


@pytest.mark.parametrize("unknown", [-1.0, 0.0])
def test_a_camera_without_autofocus_is_quiet(unknown) -> None:
    assert complaints(unknown, unknown, autofocus=unknown) == []


def wandering_by(spread: float, *, alike: bool) -> list[View]:
    """Return views by cameras whose focal lengths differ from view to view by a 1-sigma, in both eyes alike or not."""
    rng = np.random.default_rng(0)
    rig, refocus = webcams(rng), np.random.default_rng(77)

    def refocused(lens: TrueLens, factor: float) -> TrueLens:
        return replace(lens, focal_px=(factor * lens.focal_px[0], factor * lens.focal_px[1]))

    views = []
    for k, pose in enumerate(poses(rng, rig, Printed(), 14)):
        left, right = 1.0 + spread * refocus.standard_normal(2)
        moved = replace(rig, left=refocused(rig.left, left), right=refocused(rig.right, left if alike else right))
        views.append(view_of(f"{k:02d}", Photographer(moved, Printed(), Taken(), rng), pose, rng))
    return views


@pytest.fixture(scope="module")
def wandering() -> list[View]:
    """Return views by cameras whose focal lengths differ from view to view by 1.5 % (1-sigma), each by itself."""
    return wandering_by(0.015, alike=False)


def spread_of(
    views: Sequence[View], eyes: tuple[Eye, ...] = EYES, corners_m: FloatArray = BOARD.corners_m
) -> float | None:
    found = fit(views, corners_m, SIZE, "pinhole", eyes)
    return focal_spread(found.views, corners_m, found.bundle)


def of_left(views: Sequence[View]) -> list[View]:
    return [replace(view, right=None) for view in views]


def test_wandering_focal_length_is_found_with_one_eye(wandering) -> None:
    assert spread_of(of_left(wandering), ONE_EYE) == pytest.approx(0.015, rel=0.5)


def test_two_eyes_that_refocus_alike_have_their_size() -> None:
    views = wandering_by(0.01, alike=True)
    assert spread_of(views) == pytest.approx(0.01, rel=0.5)
    # The factors are those of each view, whichever eyes see it.
    some = [replace(view, right=None) if k < 4 else view for k, view in enumerate(views)]
    assert spread_of(some) == pytest.approx(0.01, rel=0.5)


def test_steady_lenses_are_quiet() -> None:
    rng = np.random.default_rng(3)
    views = of_left(corner_views(webcams(rng), rng, 14))
    assert spread_of(views, ONE_EYE) is None
    assert spread_of(views, ONE_EYE, SHEARED) is None


def test_the_boards_own_shape_hides_no_wandering(wandering) -> None:
    assert spread_of(of_left(wandering), ONE_EYE, SHEARED) == pytest.approx(0.015, rel=0.5)


def test_board_moved_between_images_is_not_refocusing() -> None:
    rng = np.random.default_rng(5)
    rig = webcams(rng)
    photographer, views = Photographer(rig, Printed(), Taken(), rng), []
    for k, (R, t) in enumerate(poses(rng, rig, Printed(), 14)):
        first, then = (view_of(str(k), photographer, (R, t + by), rng) for by in (0.0, rng.normal(0.0, 1e-3, 3)))
        views.append(replace(first, right=then.right))
    assert spread_of(views) is None


def test_a_refused_calibration_names_the_refocusing_first(wandering) -> None:
    asked = CalibrationRequest(SIZE, ("A1", "B2"), "2026-01-01T00:00:00Z", model="pinhole")
    with pytest.raises(CalibrationError, match=r"- a lens refocused between the views") as raised:
        calibrate(wandering, BOARD, asked)
    found = re.search(r"its focal length wanders by (.*)% \(1-sigma\)", str(raised.value))
    assert found is not None
    assert float(found[1]) == pytest.approx(1.5, rel=0.5)
