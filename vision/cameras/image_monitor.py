"""Check a camera's images and their times: too slow, too dark, over-exposed."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from bodyschema.interfaces.records import ImageArray
from bodyschema.vision.image_checks import is_black, too_white


class LookSettings:
    every_s = 0.5  # interval between two images that are looked at
    rate_over_s = 3.0  # time over which the frame rate is measured
    min_frames = 5  # that make a rate
    slow_share = 0.8  # of the configured rate
    step_px = 8  # between the pixels that are looked at


def exposure_fault(image: ImageArray, name: str) -> str | None:
    """Return the fault of the light in an image, or None."""
    levels = image[:: LookSettings.step_px, :: LookSettings.step_px]
    if is_black(levels):
        return f"the {name}'s image is black: is the lens cap on? Else more light, or a longer exposure_s"
    if (white := too_white(levels.min(axis=2))) is not None:
        return f"the {name} is over-exposed: {100 * white:.0f} % of its image is white. Shorten exposure_s"
    return None


class ImageMonitor:
    """Monitor of one camera's images, fed by the capturing thread and queried by others."""

    def __init__(self, name: str, fps: float) -> None:
        self._name, self._fps = name, fps
        self._times: deque[float] = deque()
        self._light: str | None = None
        self._looked_s = -np.inf
        self.frames = 0  # number of images received
        self.fps: float | None = None

    def add(self, t: float, image: ImageArray) -> None:
        """Check the newest image, taken at the time t [s]."""
        self.frames += 1
        self._times.append(t)
        while self._times[-1] - self._times[0] > LookSettings.rate_over_s:
            self._times.popleft()
        if t - self._looked_s >= LookSettings.every_s:
            self._looked_s = t
            self._light = exposure_fault(image, self._name)
            self.fps = self._rate()

    def _rate(self) -> float | None:
        """Return the frame rate [1/s] from the median interval; None if there are too few frames.

        Single lost frames do not change the median; a camera that loses every second frame counts as slow.
        """
        if len(self._times) < LookSettings.min_frames:
            return None
        return 1.0 / float(np.median([later - earlier for earlier, later in pairwise(self._times)]))

    def complaints(self) -> Iterator[str]:
        """Yield each problem with its remedy."""
        fps = self.fps
        if fps is not None and fps < LookSettings.slow_share * self._fps:
            yield (
                f"the {self._name} sends {fps:.1f} frames/s instead of {self._fps:g}: shorten exposure_s, take fourcc "
                '"MJPG" or a smaller image, give it a USB port of its own, or set buffers = 2'
            )
        if self._light is not None:
            yield self._light
