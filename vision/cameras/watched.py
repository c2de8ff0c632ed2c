"""Cameras as a person looks at them: what they see, and what the tracker makes of it."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Self

import numpy as np

from interfaces.protocols import StereoCamera, StereoEyes
from interfaces.records import ImageArray, MarkerFix, Reason, StereoFrame
from vision.config import VisionConfig
from vision.trackers import tracker_of

from .annotate import WORDS, Annotator

MOSTLY = 0.5  # of the frames: what is the matter in so many is advised on
REMEDIES: Mapping[Reason, str] = {
    Reason.NO_MARKER: "Is it in sight of both eyes, and are [vision] marker, colour, number and light right?",
    Reason.AT_BORDER: "Bring it nearer to the middle of both images.",
    Reason.OCCLUDED: "Is a hand, a cable or the tool before it, or does it move too fast for the exposure?",
    Reason.SATURATED: "Shorten exposure_s, less light.",
    Reason.REFLECTION: "Turn the lamp or what mirrors it away, or mask it.",
    Reason.REPROJECTION: "Is the paper flat, the light not too bright, and is each tag where robot.toml has it?",
    Reason.EPIPOLAR: "Are the cameras exchanged, one upside down, or moved? `bodyschema calibrate check` tells.",
    Reason.SIZE_MISMATCH: "Is its size in [vision] right? Else it is the calibration of other cameras, or they were "
    "moved: `bodyschema calibrate check`.",
    Reason.AMBIGUOUS: "Take other things of its colour, or the second tag of its number, out of sight.",
}


class WatchedCamera:
    """Frames with what was seen drawn into them.

    Attributes:
        frames: how many were looked at.
        fixes: in how many the marker was found.
        reasons: in how many it was not, by reason.
    """

    def __init__(self, camera: StereoCamera, config: VisionConfig) -> None:
        """Nothing is opened yet."""
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
        """The next picture (height, 2 width, 3); None when none came within `timeout_s`. Raises as the camera does."""
        frame = self._camera.read(timeout_s)
        if frame is None:
            return None
        seen = self._tracker.track(frame)
        self.frames += 1
        if isinstance(seen, MarkerFix):
            self.fixes += 1
        else:
            self.reasons[seen.reason] = self.reasons.get(seen.reason, 0) + 1
        return self._annotator.drawn(frame, seen)

    @property
    def said(self) -> str:
        """In how many frames the marker was found, why not in the others, and what to do where that is in most."""
        counts = sorted(self.reasons.items(), key=lambda item: -item[1])
        text = f"{self.frames} frames"
        if self.frames:
            text += f", the marker in {self.fixes}"
        text += "".join(f"; {WORDS.get(reason, reason.replace('_', ' '))}: {count}" for reason, count in counts)
        if counts and counts[0][1] > MOSTLY * self.frames and counts[0][0] in REMEDIES:
            text += f". {REMEDIES[counts[0][0]]}"
        return text


class PlainEyes:
    """Frames of cameras that nobody has calibrated yet: nothing is looked for in them.

    Attributes:
        frames: how many were looked at.
    """

    def __init__(self, eyes: StereoEyes) -> None:
        """Nothing is opened yet."""
        self._eyes = eyes
        self.frames = 0

    def __enter__(self) -> Self:
        self._eyes.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._eyes.__exit__(kind, error, trace)

    def read(self, timeout_s: float) -> ImageArray | None:
        """The next picture (height, 2 width, 3); None when none came within `timeout_s`. Raises as the eyes do."""
        frame = self._eyes.read(timeout_s)
        if frame is None:
            return None
        self.frames += 1
        return joined(frame)

    @property
    def said(self) -> str:
        """How many frames there were."""
        return f"{self.frames} frames"


def joined(frame: StereoFrame) -> ImageArray:
    """Both images side by side."""
    return np.hstack([frame.left, frame.right])
