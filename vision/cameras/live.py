"""Live cameras: one, two, or one with two eyes."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Self

import numpy as np

from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import StereoFrame

from .config import CamerasConfig, OneConfig, SideBySideConfig, TwoConfig
from .pairing import Pairing, Shot
from .v4l2.capture import Capture
from .v4l2.device import CameraDevice, OpenCapture, open_v4l2
from .v4l2.serials import serial_of


class _Settings:
    first_image_s = 5.0  # longest wait for the first whole image of each camera
    unpaired_images = 10  # more suggest that the two cameras run at different rates


@dataclass(frozen=True, slots=True)
class CameraFigures:
    """State of one camera."""

    name: str
    frames: int  # number received since it was opened
    fps: float | None  # measured frame rate; None while too few frames have arrived
    stamps: str | None  # "kernel" or "arrival"; None before any
    # damaged, rejected: numbers of images with a missing part, and with an implausible time
    damaged: int
    rejected: int


class LiveEyes:
    """`StereoEyes` of devices. Each is read in its own thread; only the newest images are kept."""

    def __init__(
        self,
        config: CamerasConfig,
        layout: OneConfig | TwoConfig | SideBySideConfig,
        clock: Clock,
        open_capture: OpenCapture = open_v4l2,
    ) -> None:
        """Store the settings without opening anything. `clock` must be monotonic, like the kernel's timestamps."""
        self._config, self._layout = config, layout
        self._changed = threading.Condition()
        self._captures = [
            self._capture(eye, CameraDevice(name, device, layout, clock, open_capture))
            for eye, (name, device) in enumerate(config.devices.items())
        ]
        self._pairing = Pairing(layout.max_gap_s if isinstance(layout, TwoConfig) else 0.0)
        self._waiting: StereoFrame | None = None
        self._last_t = -math.inf
        self._opened = ExitStack()
        self._is_open = False
        self.dropped = 0  # number of stereo images that were not read in time

    @property
    def image_size_px(self) -> tuple[int, int]:
        """Width and height of each eye's image."""
        return self._layout.image_size_px

    @property
    def serials(self) -> tuple[str, ...]:
        """Serial number of each eye's device, or its name if it has none."""
        found = tuple(serial_of(device) for device in self._config.devices.values())
        return (f"{found[0]}/left", f"{found[0]}/right") if isinstance(self._layout, SideBySideConfig) else found

    @property
    def health(self) -> tuple[str, ...]:
        """Problems of the cameras, each with its remedy."""
        return tuple(self._complaints())

    @property
    def focus_complaints(self) -> tuple[str, ...]:
        """Messages for lenses that moved or may move since the cameras were first opened, each with its remedy."""
        return tuple(text for capture in self._captures for text in capture.device.focus_complaints)

    @property
    def figures(self) -> tuple[CameraFigures, ...]:
        """State of each camera."""
        return tuple(_figures(capture) for capture in self._captures)

    def __enter__(self) -> Self:
        self._waiting = None
        with ExitStack() as stack:
            for capture in self._captures:
                stack.enter_context(capture)
            self._await_first()
            self._opened = stack.pop_all()
        self._is_open = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_open = False
        self._opened.close()

    def read(self, timeout_s: float) -> StereoFrame | None:
        """Return the newest pair of images; None if none came within `timeout_s`.

        Raises:
            SourceLost: a camera went away.
        """
        if not self._is_open:
            raise SourceError("the cameras are not open")
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._failed() is not None, timeout_s)
            frame, self._waiting = self._waiting, None
        if frame is None and (failure := self._failed()) is not None:
            raise failure
        return frame

    def _capture(self, eye: int, device: CameraDevice) -> Capture:
        return Capture(device, self._layout.fps, partial(self._take, eye), self._wake)

    def _await_first(self) -> None:
        """Raise SourceLost if an opened camera sends nothing."""
        with self._changed:
            self._changed.wait_for(lambda: not self._missing() or self._failed() is not None, _Settings.first_image_s)
        if (failure := self._failed()) is not None:
            raise failure
        for capture in self._missing():
            raise SourceLost(
                f"the {capture.device.name} sent no whole image within {_Settings.first_image_s:.0f} s "
                f"({capture.device.damaged} damaged ones). Try another cable, a port of its own, or a smaller "
                "image_size_px"
            )

    def _missing(self) -> list[Capture]:
        """Return the cameras that have sent nothing yet."""
        return [capture for capture in self._captures if capture.look.frames == 0]

    def _failed(self) -> SourceError | None:
        return next((capture.failure for capture in self._captures if capture.failure is not None), None)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _take(self, eye: int, shot: Shot) -> None:
        """Handle a new image; called in its camera's thread."""
        with self._changed:
            frame = self._whole(shot) if len(self._captures) == 1 else self._paired(eye, shot)
            if frame is not None and frame.t > self._last_t:
                self.dropped += self._waiting is not None
                self._waiting, self._last_t = frame, frame.t
            self._changed.notify_all()

    def _whole(self, shot: Shot) -> StereoFrame:
        """Return the frame of a single camera, split into two images if it shows both eyes side by side."""
        if isinstance(self._layout, OneConfig):
            sigma = math.hypot(shot.t_sigma, self._config.sigma_s)
            return StereoFrame(shot.t - self._config.latency_s, shot.image, None, sigma)
        width = self.image_size_px[0]
        left, right = np.ascontiguousarray(shot.image[:, :width]), np.ascontiguousarray(shot.image[:, width:])
        sigma = math.hypot(shot.t_sigma, self._config.sigma_s)
        return StereoFrame(shot.t - self._config.latency_s, left, right, sigma)

    def _paired(self, eye: int, shot: Shot) -> StereoFrame | None:
        self._pairing.put(eye, shot)
        pair = self._pairing.take()
        if pair is None:
            return None
        left, right = pair
        sigma = math.hypot(max(left.t_sigma, right.t_sigma), self._config.sigma_s, left.t - right.t)
        return StereoFrame(0.5 * (left.t + right.t) - self._config.latency_s, left.image, right.image, sigma)

    def _complaints(self) -> Iterator[str]:
        for capture in self._captures:
            device = capture.device
            yield from device.complaints
            yield from capture.look.complaints()
            if device.stamps.source == "arrival":
                yield (
                    f"the {device.name}'s driver gives no monotonic time stamps: images are dated when they arrive, to "
                    f"{1e3 * device.stamps.sigma_s:.0f} ms. With uvcvideo: `modprobe uvcvideo clock=MONOTONIC`"
                )
            if device.damaged > capture.look.frames:
                yield f"the {device.name} sends more damaged images than whole ones: try another cable or port"
        if self._pairing.too_far > _Settings.unpaired_images and self._pairing.gap_s is not None:
            yield (
                f"{self._pairing.too_far} times the two eyes' images were too far apart, last "
                f"{1e3 * self._pairing.gap_s:.0f} ms: do both cameras have the same fps and exposure_s?"
            )


def _figures(capture: Capture) -> CameraFigures:
    device, look = capture.device, capture.look
    return CameraFigures(
        device.name, look.frames, look.fps, device.stamps.source, device.damaged, device.stamps.rejected
    )
