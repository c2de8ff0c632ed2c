"""One view of the board by both eyes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.board import Corners

Eye = Literal["left", "right"]
EYES: tuple[Eye, Eye] = ("left", "right")
# For a single camera.
ONE_EYE: tuple[Eye, ...] = ("left",)


def image_of(eye: Eye, eyes: Sequence[Eye]) -> str:
    """Return the name of an eye's image; that of a single eye needs no side."""
    return f"{eye} image" if len(eyes) > 1 else "image"


@dataclass(frozen=True)
class View:
    """The board's corners in both eyes' images of one instant; one eye's may be missing."""

    name: str  # name of the images
    left: Corners | None
    right: Corners | None

    def eye(self, eye: Eye) -> Corners | None:
        """Return the corners seen by that eye."""
        return self.left if eye == "left" else self.right

    @property
    def is_stereo(self) -> bool:
        """True if both eyes saw the board."""
        return self.is_seen_by(EYES)

    def is_seen_by(self, eyes: Sequence[Eye]) -> bool:
        """Return True if all these eyes saw the board."""
        return all(self.eye(eye) is not None for eye in eyes)

    @property
    def corner_count(self) -> int:
        """Number of corners in both images together."""
        return sum(len(corners) for corners in (self.left, self.right) if corners is not None)


def seen_by(views: Sequence[View], eye: Eye) -> list[Corners]:
    """Return the corners that one eye saw in all views."""
    return [corners for view in views if (corners := view.eye(eye)) is not None]


def all_px(views: Sequence[View], eye: Eye) -> FloatArray:
    """Return all corners that one eye saw, shape (n, 2) [px]."""
    return np.concatenate([np.zeros((0, 2)), *(corners.px for corners in seen_by(views, eye))])
