"""Views taken automatically from live cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from board_renderer import webcams
from shown_board import BOARD, SIZE, KnownCorners, corner_views, photographed, shot

from bodyschema.interfaces.records import StereoFrame
from bodyschema.vision.board import Corners
from bodyschema.vision.calibration.live import LiveViews, Outcome
from bodyschema.vision.calibration.view import View


@pytest.fixture(scope="module")
def views() -> list[View]:
    rng = np.random.default_rng(21)
    return corner_views(webcams(rng), rng, 24)


def outcomes(shown: list[View]) -> tuple[LiveViews, list[Outcome]]:
    live = LiveViews(BOARD, KnownCorners(shown))
    return live, [live.look(shot(k)).outcome for k in range(len(shown))]


def moved(view: View, px: float) -> View:
    """Return the view with the board further to the right."""
    left, right = (
        replace(corners, px=corners.px + np.array([px, 0.0])) for corners in (view.left, view.right) if corners
    )
    return View(view.name, left, right)


def test_board_still_for_two_frames_is_taken_once(views) -> None:
    live, found = outcomes([views[0]] * 3)
    assert found == [Outcome.MOVING, Outcome.TAKEN, Outcome.KNOWN]
    assert [view.name for view in live.found.views] == ["view 1"]


def test_a_moving_board_is_not_taken(views) -> None:
    assert set(outcomes([moved(views[0], 3.0 * k) for k in range(6)])[1]) == {Outcome.MOVING}


def test_board_tilted_in_place_is_a_new_view() -> None:
    flat, tilted = tilted_in_place(0.0), tilted_in_place(25.0)
    assert outcomes([flat, flat, tilted, tilted])[1][2:] == [Outcome.MOVING, Outcome.TAKEN]


def tilted_in_place(degrees: float) -> View:
    """Return the board in the middle of both images, its centre fixed for any tilt."""
    x = BOARD.corners_m - BOARD.corners_m.mean(axis=0)
    turn = np.radians(degrees)
    x = np.stack([x[:, 0] * np.cos(turn), x[:, 1], 0.6 + x[:, 0] * np.sin(turn)], axis=1)
    px = 580.0 * x[:, :2] / x[:, 2:] + [319.5, 239.5]
    corners = Corners(np.arange(len(px)), px)
    return View("tilted", corners, corners)


def test_frames_across_a_loss_are_not_compared(views) -> None:
    live = LiveViews(BOARD, KnownCorners([views[0]] * 2))
    live.look(shot(0))
    live.forget()
    assert live.look(shot(1)).outcome is Outcome.MOVING


def test_single_eye_view_is_taken_only_while_uncovered(views) -> None:
    both = views[0]
    alone = View("alone", both.left, None)
    live, found = outcomes([alone, alone, both, both, alone, alone])
    assert found == [Outcome.MOVING, Outcome.TAKEN, Outcome.MOVING, Outcome.TAKEN, Outcome.UNSEEN, Outcome.UNSEEN]
    assert [view.is_stereo for view in live.found.views] == [False, True]


def test_views_of_all_kinds_leave_nothing_missing(views) -> None:
    live, _ = outcomes([view for view in views for _ in range(2)])
    assert live.coverage.missing() == []
    assert live.found.image_size_px == SIZE


def test_rendered_board_is_taken_and_blind_eye_named() -> None:
    pair = photographed(count=6)[1][4]
    live = LiveViews(BOARD)
    frames = [StereoFrame(0.1 * k, pair.left, pair.right) for k in range(2)]
    assert [live.look(frame).outcome for frame in frames] == [Outcome.MOVING, Outcome.TAKEN]
    look = live.look(StereoFrame(0.2, pair.left, np.zeros_like(pair.right)))
    assert (look.outcome, look.unusable[0].eye) == (Outcome.UNSEEN, "right")
    assert "lens cap" in look.unusable[0].fault.text
