"""One V4L2 camera, opened with OpenCV."""

from __future__ import annotations

import os
from collections.abc import Callable
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import ImageArray
from bodyschema.vision.cameras.config import UvcSettings
from bodyschema.vision.cameras.pairing import Shot
from bodyschema.vision.cameras.stamps import Stamps

from .controls import FocusWatch, VideoCapture, apply, raw_size_px, sends_jpeg

JPEG_END = b"\xff\xd9"
# Timeout of a read [s]; OpenCV's default is 10, and closing has to wait for it.
SELECT_TIMEOUT = ("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")

OpenCapture = Callable[[str], VideoCapture]


def open_v4l2(device: str) -> VideoCapture:
    """Open the device in OpenCV's V4L2 backend, the only one that passes on the kernel's timestamps."""
    os.environ.setdefault(*SELECT_TIMEOUT)
    return cv2.VideoCapture(device, cv2.CAP_V4L2)


class CameraDevice:
    """A camera that is opened, set up, read back and then read frame by frame, by one thread.

    Attributes:
        name: display name for messages.
        damaged: number of truncated images.
    """

    def __init__(
        self, name: str, device: str, settings: UvcSettings, clock: Clock, open_capture: OpenCapture = open_v4l2
    ) -> None:
        self.name, self._device, self._settings, self._clock = name, device, settings, clock
        self._open_capture = open_capture
        self._capture: VideoCapture | None = None
        self._is_jpeg = False
        self.stamps = Stamps()
        self._unaccepted: list[str] = []
        self._focus = FocusWatch(name)
        self.damaged = 0

    @property
    def complaints(self) -> list[str]:
        """Messages for settings that it did not accept, and for a lens that may move."""
        return [*self._unaccepted, *self.focus_complaints]

    @property
    def focus_complaints(self) -> list[str]:
        """Messages for a lens that moves or may move."""
        return list(self._focus.complaints())

    def __enter__(self) -> Self:
        if not os.path.exists(self._device):
            raise SourceLost(
                f"the {self.name} {self._device} is not there. Plug it in, and compare with `ls -l /dev/v4l/by-id`",
                brief=f"the {self.name} is not there",
            )
        capture = self._open_capture(self._device)
        if not capture.isOpened():
            capture.release()
            raise SourceLost(
                f"the {self.name} {self._device} cannot be opened. `bodyschema doctor` tells who has it, or what right "
                "is missing",
                brief=f"the {self.name} cannot be opened",
            )
        try:
            self._unaccepted = apply(capture, self._settings, self.name)
            self._is_jpeg = sends_jpeg(capture)
            if self._is_jpeg:  # decoded here, to detect truncated images
                capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        except BaseException:
            capture.release()
            raise
        self.stamps = Stamps()
        self._capture = capture
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def read(self) -> Shot | None:
        """Return the next image, or None if it cannot be used. Waits for at most about a second.

        Raises:
            SourceLost: no image came.
        """
        capture = self._capture
        if capture is None:
            raise SourceError(f"the {self.name} is not open")
        if not capture.grab():
            raise SourceLost(
                f"the {self.name} sends no images. Is it plugged in? Two cameras on one hub may be too much for the "
                "bus: give each a port of its own, or take a smaller image_size_px, fps or MJPG",
                brief=f"the {self.name} sends no images",
            )
        arrival_s = self._clock.now()
        self._focus.look(capture, arrival_s)
        kernel_s = 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
        t = self.stamps.stamp(kernel_s, arrival_s)
        if t is None:
            return None
        is_there, raw = capture.retrieve()
        image = self._decoded(raw) if is_there else None
        if image is None:
            self.damaged += 1
            return None
        return Shot(t, self.stamps.sigma_s, image)

    def _decoded(self, raw: np.ndarray) -> ImageArray | None:
        """Decode an image; return None if a part of it is missing."""
        data = raw.reshape(-1)
        if self._is_jpeg and JPEG_END not in data[-64:].tobytes():  # some cameras append a few bytes
            return None
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(data, flags) if self._is_jpeg else raw
        width, height = raw_size_px(self._settings)
        if image is None or image.shape != (height, width, 3):
            return None
        return np.asarray(image, np.uint8)
