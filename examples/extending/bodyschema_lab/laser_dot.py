"""A green laser dot, or an LED, as the marker: the brightest green spot in both eyes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, MarkerMiss, Reason, StereoFrame
from bodyschema.vision.triangulate import triangulate

HALF_PX = 6
SIGMA_PX = 0.1
ROWS_PX = 1.0


class LaserDot:
    """A `MarkerTracker`: see the Protocol in `bodyschema.vision.tracked_camera`."""

    def __init__(self, calibration: StereoCalibration, settings: Mapping[str, Any]) -> None:
        self._calibration = calibration
        self._least = float(settings.get("least_brightness", 120))

    def forget(self) -> None:
        """Do nothing: no state is kept from frame to frame."""

    def track(self, frame: StereoFrame) -> MarkerFix | MarkerMiss:
        """Locate the dot with both cameras, or return the reason for a miss."""
        right = None if frame.right is None else self._centre(frame.right)
        left = self._centre(frame.left)
        if left is None or right is None:
            return MarkerMiss(frame.t, Reason.NO_MARKER)
        if abs(left[1] - right[1]) > ROWS_PX:
            return MarkerMiss(frame.t, Reason.EPIPOLAR)
        centres = np.concatenate([left, right])
        located = triangulate(self._calibration, centres, np.full(4, SIGMA_PX**2))
        if located is None:
            return MarkerMiss(frame.t, Reason.EPIPOLAR)
        ul, vl, ur, vr = centres.tolist()
        return MarkerFix(frame.t, located[0], located[1], (ul, vl, ur, vr))

    def _centre(self, image: ImageArray) -> FloatArray | None:
        """Return column and row (2,) [px] of the greenest spot's centre of mass; None where nothing is green enough."""
        blue, green, red = np.moveaxis(image.astype(np.float64), 2, 0)
        excess = green - np.maximum(blue, red)
        v, u = np.unravel_index(int(np.argmax(excess)), excess.shape)
        height, width = excess.shape
        if excess[v, u] < self._least or not (HALF_PX <= u < width - HALF_PX and HALF_PX <= v < height - HALF_PX):
            return None
        window = np.clip(excess[v - HALF_PX : v + HALF_PX + 1, u - HALF_PX : u + HALF_PX + 1], 0.0, None)
        steps = np.arange(-HALF_PX, HALF_PX + 1)
        return np.array([u + window.sum(axis=0) @ steps / window.sum(), v + window.sum(axis=1) @ steps / window.sum()])
