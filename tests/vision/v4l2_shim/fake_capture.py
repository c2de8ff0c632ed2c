"""A fake cv2.VideoCapture, for tests that need no process of their own; the shim works at a lower level."""

from __future__ import annotations

import threading
import time

import cv2
import numpy as np

SIZE_PX = (64, 48)


class FakeCapture:
    """A camera that sends grey images with kernel stamps.

    Attributes:
        unplugged: no image comes any more.
    """

    def __init__(self, size_px: tuple[int, int] = SIZE_PX, fps: float = 100.0, phase_s: float = 0.0) -> None:
        self._values: dict[int, float] = {
            cv2.CAP_PROP_FRAME_WIDTH: size_px[0],
            cv2.CAP_PROP_FRAME_HEIGHT: size_px[1],
            cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"YUYV"),
        }
        self._image = np.full((size_px[1], size_px[0], 3), 128, np.uint8)
        self._period_s, self._phase_s = 1 / fps, phase_s
        self._stamp = 0.0
        self._wakes = threading.Event()
        self.unplugged = False

    def isOpened(self) -> bool:
        return not self.unplugged

    def set(self, propId: int, value: float, /) -> bool:
        self._values[propId] = value
        return True

    def get(self, propId: int, /) -> float:
        return 1e3 * self._stamp if propId == cv2.CAP_PROP_POS_MSEC else self._values.get(propId, 0.0)

    def grab(self) -> bool:
        now = time.monotonic()
        number = int((now - self._phase_s) / self._period_s) + 1
        self._wakes.wait(number * self._period_s + self._phase_s - now)
        self._stamp = number * self._period_s + self._phase_s
        return not self.unplugged

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, self._image.copy()

    def release(self) -> None:
        """Do nothing: nothing is held."""
