"""Balls at random places in random light, and the errors of a tracker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from ball_renderer import SMALL, Look, Room, in_eyes, paint_ball, take

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss, Reason, StereoFrame
from bodyschema.vision.ball.tracker import StereoTracker

RADIUS_M = 0.020
PLAIN = Look(noise_sd=2.0)


@dataclass(frozen=True)
class Ball:
    """A ball in the left optical frame: centre (3,) and radius [m], reflectance RGB."""

    x: tuple[float, float, float]
    radius_m: float = RADIUS_M
    rgb: tuple[float, float, float] = (0.85, 0.08, 0.08)


@dataclass(frozen=True)
class Slab:
    """A grey board that faces the cameras: corners (x, y) and depth z [m] in the left optical frame."""

    low: tuple[float, float]
    high: tuple[float, float]
    z: float
    rgb: tuple[float, float, float] = (0.35, 0.35, 0.37)


def stage(
    *things: Ball | Slab, calibration: StereoCalibration = SMALL, look: Look = PLAIN, t: float = 0.0, seed: int = 0
) -> StereoFrame:
    """Render both images of `things`, the farthest first, on a grey wall."""
    rng = np.random.default_rng(seed)
    width, height = calibration.image_size_px
    images = []
    for eye in (0, 1):
        picture = np.full((height, width, 3), 0.5)
        for thing in things:
            if isinstance(thing, Ball):
                x_eye = in_eyes(np.array(thing.x), calibration)[eye]
                lit = replace(look, ball_rgb=thing.rgb)
                picture = paint_ball(picture, x_eye, thing.radius_m, lit, calibration)
            else:
                _paint_slab(picture, thing, eye, calibration)
        images.append(take(picture, look, rng))
    return StereoFrame(t, images[0], images[1])


def reason(answer: MarkerFix | MarkerMiss | None) -> Reason | None:
    """Return the reason of a missing fix; None if there is a fix."""
    return answer.reason if isinstance(answer, MarkerMiss) else None


def sigmas_off(answer: MarkerFix | MarkerMiss, ball: Ball) -> float:
    """Return the distance of a fix from the ball in the metric of its own covariance; infinite for a miss."""
    if isinstance(answer, MarkerMiss):
        return np.inf
    error = answer.x - np.array(ball.x)
    return float(np.sqrt(error @ np.linalg.solve(answer.cov, error)))


def _paint_slab(picture: FloatArray, slab: Slab, eye: int, calibration: StereoCalibration) -> None:
    corners = [calibration.project(np.array([*corner, slab.z])) for corner in (slab.low, slab.high)]
    first, last = (np.maximum(np.rint(corner[2 * eye : 2 * eye + 2]), 0).astype(int) for corner in corners)
    picture[first[1] : last[1], first[0] : last[0]] = slab.rgb


@dataclass(frozen=True)
class Errors:
    """Fixes against the truth, n of them.

    Attributes:
        x: errors (n, 3) [m].
        sigma: stated 1-sigma (n, 3) [m].
        centres_px: errors of (ul, vl, ur, vr), shape (n, 4) [px].
        misses: reasons of the frames without a fix.
    """

    x: FloatArray
    sigma: FloatArray
    centres_px: FloatArray
    misses: tuple[Reason, ...]

    def covered(self, sigmas: float = 1.0) -> FloatArray:
        """Return the share of errors within this multiple of the stated sigma, per axis (3,)."""
        return np.mean(np.abs(self.x) < sigmas * self.sigma, axis=0)


def place(calibration: StereoCalibration, radius_px: float, rng: np.random.Generator) -> FloatArray:
    """Return a random point (3,) [m] where a ball of RADIUS_M has about this radius and is well inside both images."""
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
    """Track `frames` unrelated frames: position, size and light are random in each, rooms and exposures change."""
    rng = np.random.default_rng(seed)
    rooms = [Room(calibration, look, rng) for _ in range(max(4, frames // 8))]
    tracker = StereoTracker(calibration)
    answers = []
    for number in range(frames):
        x = place(calibration, float(np.exp(rng.uniform(*np.log(radii_px)))), rng)
        frame = rooms[number % len(rooms)].photograph(x, RADIUS_M, t=float(number))
        answers.append((x, tracker.track(frame)))
    return compare(answers, calibration)


def compare(answers: Sequence[tuple[FloatArray, MarkerFix | MarkerMiss]], calibration: StereoCalibration) -> Errors:
    """Return the errors of the tracker's answers against true positions (3,) [m]."""
    fixes = [(x, answer) for x, answer in answers if isinstance(answer, MarkerFix)]
    true = np.array([x for x, _ in fixes])
    return Errors(
        x=np.array([fix.x for _, fix in fixes]) - true,
        sigma=np.sqrt([np.diag(fix.cov) for _, fix in fixes]),
        centres_px=np.array([fix.centres_px for _, fix in fixes]) - calibration.project(true),
        misses=tuple(answer.reason for _, answer in answers if isinstance(answer, MarkerMiss)),
    )
