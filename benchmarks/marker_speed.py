"""CPU time of a stereo pair, on one core: `python benchmarks/marker_speed.py [--pairs N]`.

A ball moves a little in front of clutter, rendered by the tests' ray tracer with a webcam's noise, at 640x480 and at
1280x720, with a radius of 8 to 30 px. It is tracked, or searched for in the whole images each time. In the last variant
of each, a box of the ball's hue is beside it. Variants take turns; the round with the least CPU time counts.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, MarkerFix, StereoFrame
from bodyschema.vision.ball.tracker import StereoTracker

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "vision"))

from ball_renderer import VGA, Look, clutter, in_eyes, paint_ball, take
from scenes import RADIUS_M

WEBCAM = Look(noise_sd=1.5, shot=0.03, samples=4)
HD = replace(VGA, focal_px=900.0, principal_point_px=(639.5, 359.5), image_size_px=(1280, 720))
RADII_PX = (8.0, 15.0, 30.0)
FRAME_S = 1 / 30
BRICK_RGB = (0.55, 0.24, 0.17)


def film(calibration: StereoCalibration, radius_px: float, pairs: int, *, beside_brick: bool) -> list[StereoFrame]:
    """Render a ball on a small circle, 30 pairs a second."""
    rng = np.random.default_rng((3, calibration.image_size_px[0], round(radius_px)))
    middle = np.array([0.05, 0.02, calibration.focal_px * RADIUS_M / radius_px])
    pictures = []
    for x_eye in in_eyes(middle, calibration):
        picture = clutter(rng, calibration.image_size_px)
        if beside_brick:
            _paint_brick(picture, calibration.project(x_eye)[:2], radius_px)
        pictures.append(picture)
    frames = []
    for number in range(pairs + 1):
        x = middle + 0.003 * np.array([np.cos(0.5 * number), np.sin(0.5 * number), 0.0])
        eyes = zip(pictures, in_eyes(x, calibration), strict=True)
        images = [
            take(paint_ball(picture, x_eye, RADIUS_M, WEBCAM, calibration), WEBCAM, rng) for picture, x_eye in eyes
        ]
        frames.append(StereoFrame(number * FRAME_S, images[0], images[1]))
    return frames


def _paint_brick(picture: FloatArray, centre_px: FloatArray, radius_px: float) -> None:
    """Paint a box whose edge the ball covers by a third of its radius."""
    first = np.rint(centre_px + radius_px * np.array([0.7, -1.5])).astype(int)
    cv2.rectangle(picture, first.tolist(), (first + round(3 * radius_px)).tolist(), BRICK_RGB, -1)


def tracked(calibration: StereoCalibration, frames: list[StereoFrame], *, forget: bool) -> tuple[list[float], int]:
    """Return CPU times [s] of all frames but the first, and the number of fixes."""
    tracker = StereoTracker(calibration)
    tracker.track(frames[0])
    seconds: list[float] = []
    fixes = 0
    for frame in frames[1:]:
        if forget:
            tracker.forget()
        begin = time.process_time()
        answer = tracker.track(frame)
        seconds.append(time.process_time() - begin)
        fixes += isinstance(answer, MarkerFix)
    return seconds, fixes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=30, help="of each film")
    parser.add_argument("--rounds", type=int, default=5)
    tables_option(parser)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    films = {
        (name, radius_px, brick): (calibration, film(calibration, radius_px, arguments.pairs, beside_brick=brick))
        for name, calibration in (("640x480", VGA), ("1280x720", HD))
        for radius_px in RADII_PX
        for brick in ((False, True) if radius_px == RADII_PX[-1] else (False,))
    }
    times: dict[tuple[str, float, bool], list[list[list[float]]]] = {key: [[], []] for key in films}
    fixes: dict[tuple[str, float, bool], list[int]] = {key: [0, 0] for key in films}
    for _ in range(arguments.rounds):
        for key, (calibration, frames) in films.items():
            for column, forget in enumerate((False, True)):
                seconds, fixes[key][column] = tracked(calibration, frames, forget=forget)
                times[key][column].append(seconds)
    table = Table(
        "ball_speed",
        [
            Column("images"),
            Column("radius"),
            Column("followed", "ms", "{:.1f}"),
            Column("pairs/s", "", "{:.0f}"),
            Column("whole images", "ms", "{:.1f}"),
            Column("fixes", "", "{0} of {2} and {1} of {2}"),
        ],
    )
    for (name, radius_px, brick), columns in times.items():
        followed, whole = (1e3 * float(np.min(rounds, axis=0).mean()) for rounds in columns)
        beside = ", brick beside it" if brick else ""
        found = *fixes[name, radius_px, brick], arguments.pairs
        table.add(name, f"{radius_px:.0f} px{beside}", followed, 1e3 / followed, whole, found)
    table.save(arguments.tables)


if __name__ == "__main__":
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        # Read when NumPy is imported.
        os.execve(sys.executable, sys.orig_argv, {**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    main()
