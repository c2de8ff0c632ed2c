"""A stereo camera and a tracker as one source of marker fixes."""

from __future__ import annotations

import math
from dataclasses import replace
from types import TracebackType
from typing import Protocol, Self

from bodyschema.interfaces.protocols import StereoCamera
from bodyschema.interfaces.records import ImageArray, MarkerFix, MarkerMiss, StereoFrame

from .image_file import jpeg, shrunk


class MarkerTracker(Protocol):
    """Interface of a tracker that finds the marker in stereo images, frame by frame."""

    def track(self, frame: StereoFrame) -> MarkerFix | MarkerMiss:
        """Return the marker in `frame`, in the left optical frame, or the reason for a miss.

        Raises:
            SourceError: the images are unsuitable.
        """
        ...

    def forget(self) -> None:
        """Forget all earlier frames."""


class FrameAnnotator(Protocol):
    """Interface of an annotator, which draws a tracker's result into its frame."""

    def annotated(self, frame: StereoFrame, seen: MarkerFix | MarkerMiss) -> ImageArray:
        """Return all images side by side, with annotations."""
        ...


class TrackedCamera:
    """A `MarkerSource`: opens and closes the camera, and tracks the marker in every frame."""

    def __init__(
        self,
        camera: StereoCamera,
        tracker: MarkerTracker,
        annotator: FrameAnnotator | None = None,
        readout_s: float = 0.0,
        readout_sigma_s: float = 0.0,
    ) -> None:
        """Track in images whose first and last rows are exposed `readout_s` ± `readout_sigma_s` [s] apart."""
        self._camera, self._tracker, self._annotator = camera, tracker, annotator
        self._readout_s, self._readout_sigma_s = readout_s, readout_sigma_s
        self._newest: tuple[StereoFrame, MarkerFix | MarkerMiss] | None = None

    def __enter__(self) -> Self:
        self._camera.__enter__()
        self._tracker.forget()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._camera.__exit__(kind, error, trace)

    def picture(self) -> bytes | None:
        """Return the newest frame with its detections as JPEG, from any thread; None before the first."""
        newest = self._newest
        if newest is None or self._annotator is None:
            return None
        return jpeg(shrunk(self._annotator.annotated(*newest), widest_px=1280))  # beside other panels of a page

    def read(self, timeout_s: float) -> MarkerFix | MarkerMiss | None:
        """Return the marker in the next frame, or the reason for a miss; None if no frame came within `timeout_s` [s].

        Raises:
            SourceEnded: there will be no more.
            SourceLost: the device went away.
            SourceError: the images do not fit the calibration.
        """
        frame = self._camera.read(timeout_s)
        if frame is None:
            return None
        seen = self._tracker.track(frame)
        self._newest = frame, seen
        if not isinstance(seen, MarkerFix):
            return seen
        calibration = self._camera.calibration
        row = float(calibration.project(seen.x)[1]) / calibration.image_size_px[1]
        late_s, late_sigma_s = self._readout_s * (row - 0.5), self._readout_sigma_s * (row - 0.5)
        return replace(seen, t=seen.t + late_s, t_sigma=math.hypot(frame.t_sigma, seen.t_sigma, late_sigma_s))
