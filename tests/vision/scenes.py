"""Balls at random places in random light, and what a tracker makes of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from ball_renderer import Look, Room

from interfaces.camera import StereoCalibration
from interfaces.records import FloatArray, MarkerFix, Reason
from vision.tracker import StereoTracker

RADIUS_M = 0.020


@dataclass(frozen=True)
class Errors:
    """Fixes against the truth, n of them.

    Attributes:
        x: errors (n, 3) [m].
        sigma: claimed 1-sigma (n, 3) [m].
        centres_px: errors of (ul, vl, ur, vr), shape (n, 4) [px].
        misses: reasons of the frames without a fix.
    """

    x: FloatArray
    sigma: FloatArray
    centres_px: FloatArray
    misses: tuple[Reason, ...]

    def covered(self, sigmas: float = 1.0) -> FloatArray:
        """Share of errors within so many claimed sigmas, per axis (3,)."""
        return np.mean(np.abs(self.x) < sigmas * self.sigma, axis=0)


def place(calibration: StereoCalibration, radius_px: float, rng: np.random.Generator) -> FloatArray:
    """A random point (3,) [m] where a ball of RADIUS_M has about this radius and is well inside both images."""
    z = calibration.focal_px * RADIUS_M / radius_px
    disparity = calibration.focal_px * calibration.baseline_m / z
    width, height = calibration.image_size_px
    room = 1.2 * radius_px + 8.0
    u, v = rng.uniform((room + disparity, room), (width - room, height - room))
    cx, cy = calibration.principal_point_px
    return np.array([(u - cx) * z, (v - cy) * z, calibration.focal_px * z]) / calibration.focal_px


def measure_errors(
    calibration: StereoCalibration, look: Look, frames: int, seed: int, radii_px: tuple[float, float] = (5.0, 30.0)
) -> Errors:
    """Track `frames` unrelated frames: every place, size and light is drawn anew, each of 16 rooms has its exposure."""
    rng = np.random.default_rng(seed)
    rooms = [Room(calibration, look, rng) for _ in range(min(16, frames))]
    tracker = StereoTracker(calibration)
    found, misses = [], []
    for number in range(frames):
        x = place(calibration, float(np.exp(rng.uniform(*np.log(radii_px)))), rng)
        frame = rooms[number % len(rooms)].photograph(x, RADIUS_M, t=float(number))
        answer = tracker.track(frame)
        if isinstance(answer, MarkerFix):
            centres = np.array(answer.centres_px) - calibration.project(x)
            found.append(np.concatenate([answer.x - x, np.sqrt(np.diag(answer.cov)), centres]))
        else:
            misses.append(answer.reason)
    table = np.array(found).reshape(-1, 10)
    return Errors(table[:, :3], table[:, 3:6], table[:, 6:], tuple(misses))
