"""Views of the board from live cameras, taken automatically when the board is still and in a new pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from bodyschema.interfaces.records import StereoFrame
from bodyschema.vision.board import Board, BoardDetector

from .gather import Detector, Gathered, Unusable, eyes_of, find_board
from .guidance import cell_counts, rough_tilt_deg
from .image_pairs import ImagePair
from .settings import ViewSettings as _Settings
from .view import EYES, Eye, View, all_px


class Outcome(StrEnum):
    """Outcome of a pair of images."""

    TAKEN = "taken"
    MOVING = "moving"
    KNOWN = "known"
    UNSEEN = "unseen"


@dataclass(frozen=True)
class Look:
    """Result for one pair of images."""

    # taken as a view; the board moved; a similar view was taken before; or an eye does not see the board and the other
    # one shows nothing new
    outcome: Outcome
    view: View  # the corners in it
    unusable: tuple[Unusable, ...]  # the eyes that do not see the board, with the reason
    pair: ImagePair  # the images


class LiveViews:
    """Selection of views from a stream of image pairs.

    A view is taken when both eyes see the board, it has been still for two frames, and no similar view was taken. A
    view of a single eye is taken if it shows the board in a part of the image that is not covered yet.
    """

    def __init__(self, board: Board, detector: Detector | None = None, eyes: tuple[Eye, ...] = EYES) -> None:
        self.found = Gathered(board, eyes=eyes)  # the views taken, and their images
        self.coverage = self.found.coverage()  # image coverage of these views
        self._detector = BoardDetector(board) if detector is None else detector
        self._tilts: list[tuple[float, float]] = []
        self._before: View | None = None

    def look(self, frame: StereoFrame) -> Look:
        """Examine the next pair, and take it if it is useful.

        Raises:
            CalibrationError: the two eyes' images are of different sizes.
        """
        pair = ImagePair(f"view {len(self.found.views) + 1}", frame.left, frame.right)
        view, unusable = find_board(pair, self._detector)
        self.found.image_size_px, self.found.eyes = pair.size_px, eyes_of(pair)
        outcome = self._outcome(view)
        if outcome is Outcome.TAKEN:
            self.found.add(view, pair)
            self.coverage = self.found.coverage()
            self._tilts.append(self._tilt(view))
        self._before = view
        return Look(outcome, view, unusable, pair)

    def forget(self) -> None:
        """Forget the last pair, after the cameras were disconnected."""
        self._before = None

    def _outcome(self, view: View) -> Outcome:
        seeing: list[Eye] = [eye for eye in self.found.eyes if view.eye(eye) is not None]
        if not view.is_seen_by(self.found.eyes) and not any(self._fills(view, eye) for eye in seeing):
            return Outcome.UNSEEN
        if not self._is_new(view, seeing):
            return Outcome.KNOWN
        before = self._before
        if before is None or any(_apart_px(view, before, eye) >= _Settings.still_px for eye in seeing):
            return Outcome.MOVING
        return Outcome.TAKEN

    def _fills(self, view: View, eye: Eye) -> bool:
        """Return True if an eye sees the board in a part of its image that is not covered yet."""
        shown = cell_counts(all_px([view], eye), self.found.image_size_px) >= _Settings.corners_a_cell
        return bool((shown & ~self.coverage.covered(eye)).any())

    def _is_new(self, view: View, seeing: Sequence[Eye]) -> bool:
        least, tilt = _Settings.new_share * self.found.image_size_px[0], self._tilt(view)
        return all(
            any(_apart_px(view, other, eye) > least for eye in seeing) or math.dist(tilt, its) > _Settings.new_tilt_deg
            for other, its in zip(self.found.views, self._tilts, strict=True)
        )

    def _tilt(self, view: View) -> tuple[float, float]:
        corners = next(corners for corners in (view.left, view.right) if corners is not None)
        return rough_tilt_deg(corners, self.found.board, self.found.image_size_px)


def _apart_px(one: View, other: View, eye: Eye) -> float:
    """Return the median distance of the corners in both views; infinite if there are none."""
    a, b = one.eye(eye), other.eye(eye)
    if a is None or b is None:
        return np.inf
    _, here, there = np.intersect1d(a.numbers, b.numbers, return_indices=True)
    return float(np.median(np.linalg.norm(a.px[here] - b.px[there], axis=1))) if len(here) else np.inf
