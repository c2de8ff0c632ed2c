"""Learn a ball's colour from image files or the robot's cameras, as a table of robot.toml."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.interfaces.errors import SourceEnded
from bodyschema.interfaces.protocols import Clock, StereoEyes
from bodyschema.interfaces.records import ImageArray

READ_S = 0.2
_IMAGES = 20  # images during the observation


def learnt_colour_table(images: Sequence[Path], at: tuple[float, float] | None) -> str:
    """Return the table [vision.colour] of the ball at pixel `at` of the first image, or of the moving one.

    Raises:
        ColourUnlearnt: there is no such ball; the message says why.
    """
    from bodyschema.vision.colour_model import colour_at, colour_of_the_moving, colour_table, read_images

    shown = read_images(images)
    return colour_table(colour_of_the_moving(shown) if at is None else colour_at(shown[0], *at))


def moving_colour_table(eyes: StereoEyes, clock: Clock, seconds: float, tell: Callable[[str], None]) -> str:
    """Return the table [vision.colour] of the ball that moves in the left image during `seconds` [s].

    Args:
        eyes: cameras that are not open; they are closed again afterwards.
        tell: called with instructions and with problems of the cameras.

    Raises:
        ColourUnlearnt: nothing colourful moved.
        SourceError: the cameras cannot be opened.
    """
    from bodyschema.vision.colour_model import colour_of_the_moving, colour_table

    shown: list[ImageArray] = []
    source = ReconnectingSource(eyes, "the cameras", clock)
    with source, suppress(SourceEnded):
        began, next_t = clock.now(), -float("inf")
        tell(f"move the ball across the view for {seconds:g} s; keep the cameras still")
        while clock.now() - began < seconds:
            frame = source.read(READ_S)
            if frame is not None and frame.t >= next_t:
                next_t = frame.t + seconds / _IMAGES
                shown.append(frame.left)
            elif source.trouble is not None:
                tell(source.trouble)
    return colour_table(colour_of_the_moving(shown))
