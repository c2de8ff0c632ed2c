"""Views of the board: from images, or live with guidance about what is still missing."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from interfaces.errors import SourceEnded
from interfaces.protocols import StereoEyes
from vision.board import Board, BoardDetector, Corners, NotFound
from vision.rig import CalibrationError

from .guidance import Coverage
from .images import ImagePair, require_equal_sizes
from .view import EYES, Eye, View

_STILL_PX = 1.0  # between two frames; the median of all corners
_NEW_SHARE = 0.06  # of the image's width; how far corners have to be from those of every view that was taken


@dataclass(frozen=True)
class Unusable:
    """An image without a usable board, and why."""

    name: str
    eye: Eye
    fault: NotFound


@dataclass
class Gathered:
    """Views, the images they are from, and what could not be used.

    Attributes:
        image_size_px: of each eye; (0, 0) before the first image.
    """

    board: Board
    image_size_px: tuple[int, int] = (0, 0)
    views: list[View] = field(default_factory=list)
    images: dict[str, ImagePair] = field(default_factory=dict)
    unusable: list[Unusable] = field(default_factory=list)

    def coverage(self) -> Coverage:
        """What the views cover."""
        return Coverage.of(self.views, self.board, self.image_size_px)

    def add(self, view: View, images: ImagePair) -> None:
        """Take a view."""
        self.views.append(view)
        self.images[images.name] = images


def gathered(pairs: Iterable[ImagePair], board: Board, tell: Callable[[str], None] = lambda _: None) -> Gathered:
    """All views in images.

    Args:
        tell: is told of every image that cannot be used.

    Raises:
        CalibrationError: the two eyes' images are of different sizes.
    """
    detector = BoardDetector(board)
    found = Gathered(board)
    for pair in pairs:
        view = _looked_at(pair, detector, found, tell)
        if view.left is not None or view.right is not None:
            found.add(view, pair)
    return found


def gathered_live(
    eyes: StereoEyes, board: Board, tell: Callable[[str], None], *, longest_s: float = 600.0, timeout_s: float = 0.2
) -> Gathered:
    """Views from two cameras, until nothing is missing; `tell` is told what to show next.

    A view is taken when both eyes see the board, it has been still for two frames, and no view like it was taken.

    Args:
        eyes: open cameras.
        longest_s: when to stop though something is missing, by the time of the frames [s].

    Raises:
        SourceLost: a camera went away.
    """
    detector = BoardDetector(board)
    found = Gathered(board, eyes.image_size_px)
    before: View | None = None
    began: float | None = None
    missing = found.coverage().missing()
    tell(_wish(found, missing))
    while missing:
        try:
            frame = eyes.read(timeout_s)
        except SourceEnded:
            break
        if frame is None:
            continue
        began = frame.t if began is None else began
        if frame.t - began > longest_s:
            break
        pair = ImagePair(f"view {len(found.views) + 1}", frame.left, frame.right)
        found.unusable.clear()
        view = _looked_at(pair, detector, found, tell)
        if view.is_stereo and before is not None and _is_still(view, before) and _is_new(view, found):
            found.add(view, pair)
            missing = found.coverage().missing()
            tell(_wish(found, missing))
        before = view
    found.unusable.clear()
    return found


def _wish(found: Gathered, missing: list[str]) -> str:
    done = f"{len(found.views)} views, {found.coverage().progress:.0%}"
    return f"{done}. Next: {missing[0]}" if missing else f"{done}. Nothing is missing"


def _looked_at(pair: ImagePair, detector: BoardDetector, found: Gathered, tell: Callable[[str], None]) -> View:
    require_equal_sizes(pair.name, pair.left, pair.right)
    found.image_size_px = (pair.left.shape[1], pair.left.shape[0])
    seen: list[Corners | None] = []
    for eye, image in zip(EYES, (pair.left, pair.right), strict=True):
        corners = detector.find(image)
        if isinstance(corners, NotFound):
            found.unusable.append(Unusable(pair.name, eye, corners))
            tell(f"{pair.name}, {eye}: {corners.text}")
        seen.append(None if isinstance(corners, NotFound) else corners)
    return View(pair.name, *seen)


def _is_still(view: View, before: View) -> bool:
    return all(_apart_px(view, before, eye) < _STILL_PX for eye in EYES)


def _is_new(view: View, found: Gathered) -> bool:
    least = _NEW_SHARE * found.image_size_px[0]
    return all(max(_apart_px(view, other, eye) for eye in EYES) > least for other in found.views)


def _apart_px(one: View, other: View, eye: Eye) -> float:
    """Median distance of the corners that both views have; infinite where they have none."""
    a, b = one.eye(eye), other.eye(eye)
    if a is None or b is None:
        return np.inf
    _, here, there = np.intersect1d(a.numbers, b.numbers, return_indices=True)
    return float(np.median(np.linalg.norm(a.px[here] - b.px[there], axis=1))) if len(here) else np.inf


def require_any(found: Gathered) -> None:
    """CalibrationError where no image shows a usable board, with the reason that most have."""
    if found.views:
        return
    texts = [each.fault.text for each in found.unusable]
    if not texts:
        raise CalibrationError("there are no images")
    usual = max(set(texts), key=texts.count)
    raise CalibrationError(f"no image shows a board that can be used; {texts.count(usual)} of {len(texts)}: {usual}")
