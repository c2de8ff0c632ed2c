"""Views of the board, and gathering them from images."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Protocol

from interfaces.records import ImageArray
from vision.board import Board, BoardDetector, Corners, NotFound
from vision.rig import CalibrationError

from .guidance import Coverage
from .images import ImagePair, require_equal_sizes
from .view import EYES, Eye, View


class Detector(Protocol):
    """Finds one board; see `vision.board.BoardDetector`."""

    def find(self, image: ImageArray) -> Corners | NotFound: ...


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
        view, unusable = looked_at(pair, detector)
        found.image_size_px = pair.size_px
        found.unusable += unusable
        for each in unusable:
            tell(f"{each.name}, {each.eye}: {each.fault.text}")
        if view.left is not None or view.right is not None:
            found.add(view, pair)
    return found


def looked_at(pair: ImagePair, detector: Detector) -> tuple[View, tuple[Unusable, ...]]:
    """The board's corners in a pair of images, and why an eye has none.

    Raises:
        CalibrationError: the two eyes' images are of different sizes.
    """
    require_equal_sizes(pair.name, pair.left, pair.right)
    seen: list[Corners | None] = []
    unusable: list[Unusable] = []
    for eye, image in zip(EYES, (pair.left, pair.right), strict=True):
        corners = detector.find(image)
        if isinstance(corners, NotFound):
            unusable.append(Unusable(pair.name, eye, corners))
        seen.append(None if isinstance(corners, NotFound) else corners)
    return View(pair.name, *seen), tuple(unusable)


def require_any(found: Gathered) -> None:
    """CalibrationError where no image shows a usable board, with the reason that most have."""
    if found.views:
        return
    texts = [each.fault.text for each in found.unusable]
    if not texts:
        raise CalibrationError("there are no images")
    usual = max(set(texts), key=texts.count)
    raise CalibrationError(f"no image shows a board that can be used; {texts.count(usual)} of {len(texts)}: {usual}")
