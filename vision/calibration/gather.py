"""Views of the board, gathered from images."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from bodyschema.interfaces.records import ImageArray
from bodyschema.vision.board import OTHER_BOARD, Board, BoardDetector, Corners, NotFound
from bodyschema.vision.rig.stereo_rig import CalibrationError

from .guidance import Coverage
from .image_pairs import ImagePair, require_equal_sizes
from .view import EYES, ONE_EYE, Eye, View, image_of


class _Settings:
    max_names = 4  # of images in a message
    # Number of pairs after which another board is certain, and interval of progress messages.
    sure_pairs, told_pairs = 3, 10


_NUMBERS = re.compile(r"\d+(\.\d+)?")


class Detector(Protocol):
    """Interface of a board detector; see `bodyschema.vision.board.BoardDetector`."""

    def find(self, image: ImageArray) -> Corners | NotFound: ...


@dataclass(frozen=True)
class Unusable:
    """An image without a usable board, and the reason."""

    name: str
    eye: Eye
    fault: NotFound


@dataclass
class Gathered:
    """Views, their images, and the images that could not be used."""

    board: Board
    image_size_px: tuple[int, int] = (0, 0)  # of each eye; (0, 0) before the first image
    views: list[View] = field(default_factory=list)
    images: dict[str, ImagePair] = field(default_factory=dict)
    unusable: list[Unusable] = field(default_factory=list)
    eyes: tuple[Eye, ...] = EYES  # the eyes in use

    def coverage(self) -> Coverage:
        """Return the image coverage of the views."""
        return Coverage.of(self.views, self.board, self.image_size_px, self.eyes)

    def add(self, view: View, images: ImagePair) -> None:
        """Add a view."""
        self.views.append(view)
        self.images[images.name] = images


def gathered(pairs: Iterable[ImagePair], board: Board, tell: Callable[[str], None] = lambda _: None) -> Gathered:
    """Gather all views from images; stop early if the first images show another board.

    Args:
        tell: receives progress, and one line for each reason and eye with the images that cannot be used.

    Raises:
        CalibrationError: the two eyes' images are of different sizes.
    """
    detector = BoardDetector(board)
    found = Gathered(board)
    for number, pair in enumerate(pairs, start=1):
        view, unusable = find_board(pair, detector)
        found.image_size_px, found.eyes = pair.size_px, eyes_of(pair)
        found.unusable += unusable
        if view.left is not None or view.right is not None:
            found.add(view, pair)
        if (
            number == _Settings.sure_pairs
            and not found.views
            and all(one.fault.why in OTHER_BOARD for one in found.unusable)
        ):
            break
        if number % _Settings.told_pairs == 0:
            tell(f"{number} pairs looked at; the board is in {len(found.views)}")
    for line in summary_lines(found.unusable, found.eyes):
        tell(line)
    return found


def summary_lines(unusable: Sequence[Unusable], eyes: Sequence[Eye] = EYES) -> list[str]:
    """Return one line for each eye and reason with the unusable images; differences in numbers are ignored."""
    by_kind: dict[tuple[Eye, str], list[Unusable]] = {}
    for each in unusable:
        by_kind.setdefault((each.eye, _kind(each)), []).append(each)
    return [
        f"{_named(group)}{f', {eye} image' if len(eyes) > 1 else ''}: {_usual([each.fault.text for each in group])}"
        for (eye, _), group in by_kind.items()
    ]


def _kind(unusable: Unusable) -> str:
    return _NUMBERS.sub("#", unusable.fault.text)


def _named(group: Sequence[Unusable]) -> str:
    names = [each.name for each in group]
    if len(names) <= _Settings.max_names:
        return ", ".join(names)
    return f"{', '.join(names[: _Settings.max_names - 1])} and {len(names) - _Settings.max_names + 1} more"


def _usual(texts: Sequence[str]) -> str:
    return Counter(texts).most_common(1)[0][0]


def eyes_of(pair: ImagePair) -> tuple[Eye, ...]:
    """Return the eyes for which a pair has images."""
    return ONE_EYE if pair.right is None else EYES


def find_board(pair: ImagePair, detector: Detector) -> tuple[View, tuple[Unusable, ...]]:
    """Find the board's corners in a pair of images, with the reason for each eye without corners.

    Raises:
        CalibrationError: the two eyes' images are of different sizes.
    """
    if pair.right is not None:
        require_equal_sizes(pair.name, pair.left, pair.right)
    seen: list[Corners | None] = []
    unusable: list[Unusable] = []
    for eye, image in zip(eyes_of(pair), pair.images, strict=True):
        corners = detector.find(image)
        if isinstance(corners, NotFound):
            unusable.append(Unusable(pair.name, eye, corners))
        seen.append(None if isinstance(corners, NotFound) else corners)
    return View(pair.name, seen[0], seen[1] if len(seen) > 1 else None), tuple(unusable)


def require_both(found: Gathered) -> None:
    """Raise CalibrationError with the most frequent reason if an eye sees no usable board in any image."""
    if not found.views and not found.unusable:
        raise CalibrationError("there are no images")
    blind: list[Eye] = [eye for eye in found.eyes if all(view.eye(eye) is None for view in found.views)]
    if not blind:
        return
    faults = [each for each in found.unusable if each.eye in blind]
    kind = _usual([_kind(each) for each in faults])
    by_kind = [each.fault.text for each in faults if _kind(each) == kind]
    who = "no image" if len(blind) == len(found.eyes) else f"no {image_of(blind[0], found.eyes)}"
    raise CalibrationError(f"{who} shows a board that can be used; {len(by_kind)} of {len(faults)}: {_usual(by_kind)}")
