"""Compare the marker's depth from the two eyes with the depth image of the camera."""

from __future__ import annotations

import math
from collections import deque
from types import TracebackType
from typing import Protocol, Self

import numpy as np

from bodyschema.interfaces.protocols import MarkerSource
from bodyschema.interfaces.records import MarkerFix, MarkerMiss


class _Settings:
    # Frames that are judged, and the share of them that has to contradict: a reflection may be taken for the marker at
    # times.
    frames, contradicting_share = 20, 0.2
    sigmas = 4.0  # between the two distances: more is a contradiction
    depth_error = 0.02  # of the distance, as the maker promises up to 2 m


class DepthImage(Protocol):
    """A camera with a depth image; see `bodyschema.vision.cameras.realsense.RealsenseCamera`."""

    def depth_m(self, u: float, v: float) -> float | None:
        """Return the depth at a pixel of the left image [m]; None if it is unknown."""


class DepthChecked:
    """A `MarkerSource` whose depths are compared with the depth image; only its health reports the result."""

    def __init__(self, marker: MarkerSource, depth: DepthImage, in_front_m: float) -> None:
        """Store the settings.

        Args:
            in_front_m: distance of the marker's surface in front of its centre: a ball's radius [m].
        """
        self._marker, self._depth, self._in_front_m = marker, depth, in_front_m
        self._apart: deque[tuple[float, float, float]] = deque(maxlen=_Settings.frames)

    @property
    def health(self) -> tuple[str, ...]:
        """A persistent contradiction, with the remedy."""
        wrong = [(eyes, depth) for eyes, depth, sigmas in self._apart if sigmas > _Settings.sigmas]
        if len(self._apart) < _Settings.frames or len(wrong) < _Settings.contradicting_share * _Settings.frames:
            return ()
        eyes, depth = np.median(wrong, axis=0)
        return (
            f"the depth image has the marker at {depth:.3f} m where the two eyes measure {eyes:.3f} m, in {len(wrong)} "
            f"of {_Settings.frames} frames: is something else taken for the marker? If not, run the device's own "
            "calibration (RealSense Viewer, On-Chip Calibration)",
        )

    def __enter__(self) -> Self:
        self._marker.__enter__()
        self._apart.clear()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._marker.__exit__(kind, error, trace)

    def read(self, timeout_s: float) -> MarkerFix | MarkerMiss | None:
        """Return the fix or miss of the marker source; see `MarkerSource.read`."""
        seen = self._marker.read(timeout_s)
        if isinstance(seen, MarkerFix) and seen.centres_px is not None:
            surface = self._depth.depth_m(*seen.centres_px[:2])
            if surface is not None:
                depth, eyes = surface + self._in_front_m, float(seen.x[2])
                sigma = math.hypot(math.sqrt(float(seen.cov[2, 2])), _Settings.depth_error * eyes)
                self._apart.append((eyes, depth, abs(depth - eyes) / sigma))
        return seen
