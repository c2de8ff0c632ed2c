"""Camera thread that hands on the newest image and keeps no queue."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from bodyschema.interfaces.errors import SourceError
from bodyschema.vision.cameras.image_monitor import ImageMonitor
from bodyschema.vision.cameras.pairing import Shot

from .device import CameraDevice

log = logging.getLogger(__name__)


class Capture:
    """Thread that reads a device as fast as it sends and hands each image on."""

    def __init__(
        self, device: CameraDevice, fps: float, take: Callable[[Shot], None], wake: Callable[[], None]
    ) -> None:
        """Create the thread's state without opening the device.

        Args:
            fps: expected frame rate [1/s].
            take: called with each image, in the thread.
            wake: called in the thread when it ends.
        """
        self._device, self._fps, self._take, self._wake = device, fps, take, wake
        self.look = ImageMonitor(device.name, fps)  # statistics of the camera from its images
        self.failure: SourceError | None = None  # error that ended the thread, or None
        self._opened = ExitStack()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def device(self) -> CameraDevice:
        """The camera."""
        return self._device

    def __enter__(self) -> Self:
        self.failure, self.look = None, ImageMonitor(self._device.name, self._fps)
        self._stopping.clear()
        self._opened.enter_context(self._device)
        self._thread = threading.Thread(target=self._run, name=self._device.name, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._opened.close()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                shot = self._device.read()
                if shot is not None:
                    self.look.add(shot.t, shot.image)
                    self._take(shot)
        except SourceError as error:
            self.failure = error
        except Exception as error:
            log.exception("the thread of the %s failed", self._device.name)
            self.failure = SourceError(f"the {self._device.name}: {error}")
        self._wake()
