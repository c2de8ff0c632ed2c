"""Camera frames for display, with the tracker's result drawn into them."""

from __future__ import annotations

from types import TracebackType
from typing import Self

import numpy as np

from bodyschema.interfaces.protocols import StereoCamera, StereoEyes
from bodyschema.interfaces.records import ImageArray, MarkerFix, Reason, StereoFrame
from bodyschema.interfaces.rejections import REMEDIES, WORDS
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.trackers import tracker_of

from .annotate import Annotator


class WatchedCamera:
    """Camera frames annotated with the tracker's result.

    Attributes:
        frames: number of frames read.
        fixes: number of frames with a marker fix.
        reasons: number of misses, by reason.
    """

    def __init__(self, camera: StereoCamera, config: VisionConfig) -> None:
        self._camera = camera
        self._tracker = tracker_of(camera.calibration, config)
        self._annotator = Annotator(camera.calibration, config)
        self.frames, self.fixes = 0, 0
        self.reasons: dict[Reason, int] = {}

    def __enter__(self) -> Self:
        self._camera.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._camera.__exit__(kind, error, trace)

    def read(self, timeout_s: float) -> ImageArray | None:
        """Return the next annotated picture (height, eyes width, 3), or None in time. Raise the camera's errors."""
        frame = self._camera.read(timeout_s)
        if frame is None:
            return None
        seen = self._tracker.track(frame)
        self.frames += 1
        if isinstance(seen, MarkerFix):
            self.fixes += 1
        else:
            self.reasons[seen.reason] = self.reasons.get(seen.reason, 0) + 1
        return self._annotator.annotated(frame, seen)

    @property
    def said(self) -> str:
        """Summary of fixes and misses by reason, with a remedy if one reason dominates."""
        counts = sorted(self.reasons.items(), key=lambda item: -item[1])
        text = f"{self.frames} frames"
        if self.frames:
            text += f", the marker in {self.fixes}"
        text += "".join(f"; {WORDS[reason]}: {count}" for reason, count in counts)
        if counts and counts[0][1] > 0.5 * self.frames:
            text += f". {REMEDIES[counts[0][0]]}"
        return text


class PlainEyes:
    """Frames of cameras without a calibration, in which nothing is detected."""

    def __init__(self, eyes: StereoEyes) -> None:
        self._eyes = eyes
        self.frames = 0  # number of frames read

    def __enter__(self) -> Self:
        self._eyes.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._eyes.__exit__(kind, error, trace)

    def read(self, timeout_s: float) -> ImageArray | None:
        """Return the next picture (height, eyes width, 3); None if none came in time. Raise the errors of the eyes."""
        frame = self._eyes.read(timeout_s)
        if frame is None:
            return None
        self.frames += 1
        return joined(frame)

    @property
    def said(self) -> str:
        """Number of frames read, as text."""
        return f"{self.frames} frames"


def joined(frame: StereoFrame) -> ImageArray:
    """Join all eyes' images side by side."""
    return np.hstack(frame.images)
