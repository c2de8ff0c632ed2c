"""A ball's colour, learnt from image files, as the table of robot.toml."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def learnt_colour_table(images: Sequence[Path], at: tuple[float, float] | None) -> str:
    """The table [vision.colour] of the ball at the pixel `at` of the first image, or of the one that moves.

    Raises:
        ColourUnlearnt: there is no such ball; the message says why.
    """
    from vision.colour_model import colour_at, colour_of_the_moving, colour_table, read_images

    shown = read_images(images)
    return colour_table(colour_of_the_moving(shown) if at is None else colour_at(shown[0], *at))
