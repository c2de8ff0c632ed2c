"""A stereo camera and a tracker as one source of marker fixes."""

from __future__ import annotations

from dataclasses import replace
from types import TracebackType
from typing import Protocol, Self

from bodyschema.interfaces.protocols import StereoCamera
from bodyschema.interfaces.records import MarkerFix, MarkerMiss, StereoFrame


class MarkerTracker(Protocol):
    """Interface of a tracker that finds the marker in stereo images, frame by frame."""

    def track(self, frame: StereoFrame) -> MarkerFix | MarkerMiss:
        """Return the marker in `frame`, in the left optical frame, or the reason for a miss; SourceError for unfit
        images.
        """
        ...

    def forget(self) -> None:
        """Forget all earlier frames."""
        ...


class TrackedCamera:
    """A `MarkerSource`: opens and closes the camera, and tracks the marker in every frame."""

    def __init__(self, camera: StereoCamera, tracker: MarkerTracker) -> None:
        self._camera, self._tracker = camera, tracker

    def __enter__(self) -> Self:
        self._camera.__enter__()
        self._tracker.forget()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._camera.__exit__(kind, error, trace)

    def read(self, timeout_s: float) -> MarkerFix | MarkerMiss | None:
        """Return the marker in the next frame, or the reason for a miss; None if no frame came within `timeout_s`
        [s].

        Raises:
            SourceEnded: there will be no more.
            SourceLost: the device went away.
            SourceError: the images do not fit the calibration.
        """
        frame = self._camera.read(timeout_s)
        if frame is None:
            return None
        seen = self._tracker.track(frame)
        return replace(seen, t_sigma=frame.t_sigma) if isinstance(seen, MarkerFix) else seen
