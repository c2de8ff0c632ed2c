"""Accuracy of the marker's centre, compared with OpenCV's detectors: `python benchmarks/marker_centres.py`.

Random balls of 5 to 40 px radius, rendered by the tests' ray tracer, with a webcam's noise (light and sensor). All
detectors get the same image region, the same colour mask, and the correction for the sphere's ellipse with the true
distance. Then the error in space at 1 m is compared with the Cramér-Rao bound, computed from the derivative of the
rendered pixels by the ball's position; the bound takes all else as known.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, StereoFrame
from bodyschema.vision.ball.blob import Disc, Region, find_patches, measure
from bodyschema.vision.ball.colour import ColourGate
from bodyschema.vision.ball.sphere import Pinhole
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.config import VisionConfig

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "vision"))

from ball_renderer import VGA, Look, backdrop, in_eyes, paint_ball, random_light, take
from scenes import RADIUS_M, place

WEBCAM = Look(noise_sd=1.5, shot=0.03, samples=8)
LOOKS = {"even wall": replace(WEBCAM, wall=0.5), "clutter": WEBCAM, "clutter, JPEG 90": replace(WEBCAM, jpeg=90)}
AT_ONE_METRE = replace(VGA, focal_px=900.0)
CONFIG = VisionConfig()
GATE = ColourGate(CONFIG.band)
EYE = Pinhole(VGA.focal_px, VGA.principal_point_px)
Detector = Callable[[ImageArray, ImageArray, float], FloatArray | None]


def by_contour(image: ImageArray, mask: ImageArray, radius_px: float) -> FloatArray | None:  # noqa: ARG001
    """Locate the ball by cv2.fitEllipse on the longest contour of the mask."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(contours, key=len, default=None)
    return None if longest is None or len(longest) < 5 else np.array(cv2.fitEllipse(longest)[0])


def by_circles(image: ImageArray, mask: ImageArray, radius_px: float) -> FloatArray | None:  # noqa: ARG001
    """Locate the ball by cv2.HoughCircles on the brightness of the colour, given the radius to a quarter."""
    amount = np.clip(GATE.amount(image), 0, 255).astype(np.uint8)
    low, high = int(0.75 * radius_px), int(np.ceil(1.25 * radius_px))
    found = cv2.HoughCircles(
        amount, cv2.HOUGH_GRADIENT_ALT, 1.0, 2.0 * radius_px, param1=150, param2=0.6, minRadius=low, maxRadius=high
    )
    if found is None:
        found = cv2.HoughCircles(
            amount, cv2.HOUGH_GRADIENT, 1.0, 2.0 * radius_px, param1=150, param2=8, minRadius=low, maxRadius=high
        )
    return None if found is None else found.reshape(-1, found.shape[-1])[0, :2].astype(np.float64)


def by_blob(image: ImageArray, mask: ImageArray, radius_px: float) -> FloatArray | None:  # noqa: ARG001
    """Locate the ball by cv2.SimpleBlobDetector on the brightness of the colour, given the area to a factor of two."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.filterByColor, settings.blobColor = True, 255
    settings.filterByArea, settings.minArea, settings.maxArea = True, 1.5 * radius_px**2, 6.3 * radius_px**2
    settings.filterByInertia = settings.filterByConvexity = False
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = 20, 200, 10
    amount = np.clip(GATE.amount(image), 0, 255).astype(np.uint8)
    found = cv2.SimpleBlobDetector.create(settings).detect(amount)
    return np.array(max(found, key=lambda point: point.size).pt) if found else None


RIVALS: dict[str, Detector] = {
    "contour, fitEllipse": by_contour,
    "SimpleBlobDetector": by_blob,
    "HoughCircles": by_circles,
}


def ours(image: ImageArray, region: Region) -> FloatArray | None:
    for patch in find_patches(image, region, GATE):
        disc = measure(image, patch, EYE, GATE, CONFIG)
        if isinstance(disc, Disc):
            return disc.centre_px
    return None


def compare_centres(table: Table, name: str, look: Look, frames: int, seed: int) -> None:
    """Add a row of errors for each detector."""
    rng = np.random.default_rng(seed)
    errors: dict[str, list[FloatArray]] = {"tracker": [], **{rival: [] for rival in RIVALS}}
    seconds = dict.fromkeys(errors, 0.0)
    for _ in range(frames):
        radius_px = float(np.exp(rng.uniform(*np.log((5.0, 40.0)))))
        x = place(VGA, radius_px, rng)
        lit = replace(random_light(rng, look), exposure=float(rng.uniform(0.6, 1.0)))
        image = take(paint_ball(backdrop(rng, VGA.image_size_px, look.wall), x, RADIUS_M, lit, VGA), lit, rng)
        true = VGA.project(x)[:2]
        half = round(1.5 * radius_px + 10)
        middle = np.rint(true + rng.uniform(-3, 3, 2)).astype(int)
        region = Region(*np.maximum(middle - half, 0).tolist(), *np.minimum(middle + half, VGA.image_size_px).tolist())
        distance = float(np.linalg.norm(x)) / RADIUS_M
        corner = np.array([region.left, region.top])
        for rival, found in errors.items():
            begin = time.perf_counter()
            if rival == "tracker":
                centre = ours(image, region)
            else:
                pixels = region.crop(image)
                centre = RIVALS[rival](pixels, GATE.mask(pixels), radius_px)
                centre = None if centre is None else centre + corner
            seconds[rival] += time.perf_counter() - begin
            if centre is not None and np.linalg.norm(centre - true) < radius_px:
                found.append(EYE.sphere_centre(centre, distance) - true)
    for rival, found in errors.items():
        off = np.array(found)
        rms, worst = np.sqrt(np.mean(off**2)), np.quantile(np.abs(off), 0.99)
        bias = np.abs(off.mean(axis=0)).max()
        found_percent, each_ms = 100 * len(off) / frames, 1e3 * seconds[rival] / frames
        table.add(f"{name}, {rival}", rms, np.median(np.abs(off)), worst, bias, found_percent, each_ms)


def information(x: FloatArray, look: Look, pictures: list[FloatArray], calibration: StereoCalibration) -> FloatArray:
    """Return the Fisher information (3, 3) [1/m²] of the ball's position in the noisy pixels of both cameras."""
    total = np.zeros((3, 3))
    fine = replace(look, samples=16)
    # Large compared with the rays' spacing, small compared with the blur: 0.2 px.
    steps = np.diag([2e-4, 2e-4, 2e-3])
    for eye, picture in enumerate(pictures):

        def light(at: FloatArray, eye: int = eye, picture: FloatArray = picture) -> FloatArray:
            painted = paint_ball(picture, in_eyes(at, calibration)[eye], RADIUS_M, fine, calibration)
            blurred = cv2.GaussianBlur(255.0 * look.exposure * painted, (0, 0), look.blur_px)
            return np.asarray(blurred, dtype=np.float64)

        middle = light(x)
        slopes = [(light(x + step) - light(x - step)) / (2 * step.sum()) for step in steps]
        # Over-exposed pixels carry no information.
        weight = np.where(middle < 254.5, 1.0 / (look.noise_sd**2 + look.shot * middle + 1 / 12), 0.0)
        total += np.array([[np.sum(weight * one * other) for other in slopes] for one in slopes])
    return total


def against_the_bound(table: Table, name: str, look: Look, frames: int, bounds: int, seed: int) -> None:
    """Add the error in space at 1 m beside its bound."""
    rng = np.random.default_rng(seed)
    tracker = StereoTracker(AT_ONE_METRE)
    errors, sigmas, limits = [], [], []
    for number in range(frames):
        x = place(AT_ONE_METRE, 18.0, rng)
        lit = replace(random_light(rng, look), exposure=float(rng.uniform(0.6, 1.0)))
        pictures = [backdrop(rng, VGA.image_size_px, look.wall) for _ in range(2)]
        eyes = zip(pictures, in_eyes(x, AT_ONE_METRE), strict=True)
        images = [take(paint_ball(picture, x_eye, RADIUS_M, lit, AT_ONE_METRE), lit, rng) for picture, x_eye in eyes]
        tracker.forget()
        answer = tracker.track(StereoFrame(float(number), images[0], images[1]))
        if isinstance(answer, MarkerFix):
            errors.append(answer.x - x)
            sigmas.append(np.sqrt(np.diag(answer.cov)))
        if number < bounds:
            limits.append(np.diag(np.linalg.inv(information(x, lit, pictures, AT_ONE_METRE))))
    off = np.array(errors)
    rms, bound = np.sqrt(np.mean(off**2, axis=0)), np.sqrt(np.mean(limits, axis=0))
    covered = 100 * np.mean(np.abs(off) < np.array(sigmas), axis=0)
    spread = np.quantile(np.abs(off), 0.683, axis=0)
    table.add(name, 1e6 * rms, 1e6 * bound, rms / bound, spread / bound, covered, [len(off), frames])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=400, help="images of each kind")
    parser.add_argument("--bounds", type=int, default=12, help="frames whose bound is computed")
    parser.add_argument("--seed", type=int, default=1)
    tables_option(parser)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    px = [Column(name, "px", "{:.3f}") for name in ("RMS", "median", "99 %", "bias")]
    costs = Column("found", "%", "{:.1f}"), Column("time", "ms", "{:.2f}")
    centres = Table("ball_centres", [Column("scene, detector"), *px, *costs])
    for name, look in LOOKS.items():
        compare_centres(centres, name, look, arguments.frames, arguments.seed)
    centres.save(arguments.tables)
    whole, ratio = "{:.0f} {:.0f} {:.0f}", "{:.2f} {:.2f} {:.2f}"
    at_one_metre = Table(
        "ball_bound",
        [
            Column("at 1 m"),
            Column("RMS x y z", "µm", whole),
            Column("bound", "µm", whole),
            Column("RMS / bound", "", ratio),
            Column("68 % / bound", "", ratio),
            Column("within 1 sigma", "%", whole),
            Column("fixes", "", "{} of {}"),
        ],
    )
    print()
    for name in ("even wall", "clutter"):
        look, frames = LOOKS[name], arguments.frames // 2
        against_the_bound(at_one_metre, name, look, frames, arguments.bounds, arguments.seed)
    at_one_metre.save(arguments.tables)


if __name__ == "__main__":
    main()
