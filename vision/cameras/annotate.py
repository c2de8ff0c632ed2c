"""Camera images annotated with the detections of the tracker."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, MarkerMiss, Reason, StereoFrame
from bodyschema.interfaces.rejections import WORDS
from bodyschema.vision.ball.blob import Region, find_patches, measure
from bodyschema.vision.ball.colour import gate_of
from bodyschema.vision.ball.sphere import Pinhole
from bodyschema.vision.config import VisionConfig

from .annotate_tags import SUBPIXEL_BITS, TagDrawing, TagSight, outline

GREEN, YELLOW, RED, BLACK = (80, 220, 80), (0, 220, 255), (110, 110, 255), (0, 0, 0)
FONT, LETTERS, LINE_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.5, 18


@dataclass(frozen=True, slots=True)
class Sight:
    """One patch of the marker's colour in one eye."""

    # centre_px, radius_px: of the disc, or roughly of the patch if it is no disc
    centre_px: tuple[float, float]
    radius_px: float
    reason: Reason | None  # reason why it is no disc, or None


class Annotator:
    """Annotator for the frames of one camera."""

    def __init__(self, calibration: StereoCalibration, config: VisionConfig) -> None:
        self._calibration, self._config = calibration, config
        self._gate = gate_of(config)
        self._is_ball = config.marker in ("ball", "bright_ball")
        self._tags = TagDrawing(calibration, config) if config.marker in ("tag", "cluster", "chessboard") else None
        self._eye = Pinhole(calibration.focal_px, calibration.principal_point_px)
        width, height = calibration.image_size_px
        self._whole = Region(0, 0, width, height)

    def sights(self, image: ImageArray) -> list[Sight]:
        """Return everything in one eye's image that looks like the ball, marker or not; empty for tags."""
        if not self._is_ball:
            return []
        found = []
        for patch in find_patches(image, self._whole, self._gate):
            outcome = measure(image, patch, self._eye, self._gate, self._config)
            if isinstance(outcome, Reason):
                found.append(Sight(_pair(patch.centre_px), patch.radius_px, outcome))
            else:
                found.append(Sight(_pair(outcome.centre_px), outcome.radius_px, None))
        return found

    def annotated(self, frame: StereoFrame, seen: MarkerFix | MarkerMiss) -> ImageArray:
        """Return all images side by side (height, eyes width, 3), with annotations."""
        eyes = [np.ascontiguousarray(image).copy() for image in frame.images]
        sights = [self.sights(image) for image in frame.images]
        if self._tags is not None:
            for eye, image in zip(eyes, frame.images, strict=True):
                for tag in self._tags.sights(image):
                    _draw_tag(eye, tag)
        for place, eye in enumerate(eyes):
            for sight in sights[place]:
                self._draw_sight(eye, sight)
            if isinstance(seen, MarkerMiss) and len(eyes) > 1:
                for sight in sights[1 - place]:  # expected rows of the other eye's discs
                    if sight.reason is None:
                        _row(eye, sight.centre_px[1], YELLOW)
        if isinstance(seen, MarkerFix):
            self._draw_fix(eyes, seen)
            if self._tags is not None:
                self._tags.draw_fix(eyes, seen, GREEN)
        joined = np.hstack(eyes)
        _write(joined, self._headline(frame, seen), (6, LINE_PX), GREEN if isinstance(seen, MarkerFix) else RED)
        return joined

    def _draw_sight(self, image: ImageArray, sight: Sight) -> None:
        colour = YELLOW if sight.reason is None else RED
        _circle(image, sight.centre_px, sight.radius_px, colour)
        if sight.reason is not None:
            at = round(sight.centre_px[0] - sight.radius_px), round(sight.centre_px[1] - sight.radius_px) - 6
            _write(image, WORDS[sight.reason], at, RED)

    def _draw_fix(self, eyes: list[ImageArray], fix: MarkerFix) -> None:
        """Draw the marker projected from the fix, and its row in the other eye."""
        radius_px = self._calibration.focal_px * self._config.radius_m / float(fix.x[2]) if self._is_ball else 0.0
        if not self._calibration.is_stereo:
            u, v = self._calibration.project(fix.x)[:2].tolist()
            if self._is_ball:
                _circle(eyes[0], (u, v), radius_px, GREEN)
            cv2.drawMarker(eyes[0], (round(u), round(v)), GREEN, cv2.MARKER_CROSS, 9)
        if fix.centres_px is None:
            return
        ul, vl, ur, vr = fix.centres_px
        for image, own, other in ((eyes[0], (ul, vl), vr), (eyes[1], (ur, vr), vl)):
            if self._is_ball:
                _circle(image, own, radius_px, GREEN)
            cv2.drawMarker(image, (round(own[0]), round(own[1])), GREEN, cv2.MARKER_CROSS, 9)
            _row(image, other, YELLOW)
            # The distance to the other eye's row, a fraction of a pixel, ten times as long to be visible.
            end = own[1] + 10 * (other - own[1])
            at = round(own[0] + 2 * radius_px) + 6
            cv2.line(image, (at, round(own[1])), (at, round(end)), RED, 2)

    def _headline(self, frame: StereoFrame, seen: MarkerFix | MarkerMiss) -> str:
        if isinstance(seen, MarkerMiss):
            return f"{frame.t:.3f} s  refused: {WORDS[seen.reason]}"
        x, y, z = 1e3 * seen.x
        sigma = 1e3 * float(np.sqrt(np.linalg.eigvalsh(seen.cov)[-1]))
        rows = "" if seen.centres_px is None else f"  rows differ {seen.centres_px[3] - seen.centres_px[1]:+.2f} px"
        return f"{frame.t:.3f} s  x {x:.1f} y {y:.1f} z {z:.1f} mm +- {sigma:.2f}{rows}"


def _draw_tag(image: ImageArray, tag: TagSight) -> None:
    """Draw a tag's outline and number: yellow if it is measured, red with the reason if not."""
    why = WORDS[tag.reason] if tag.reason is not None else ""
    why = why if tag.is_wanted else "not the marker's"
    colour = RED if why else YELLOW
    outline(image, tag.corners_px, colour)
    left, top = tag.corners_px.min(axis=0)
    _write(image, f"{tag.id}: {why}" if why else str(tag.id), (round(left), round(top) - 8), colour)


def _pair(centre_px: FloatArray) -> tuple[float, float]:
    return float(centre_px[0]), float(centre_px[1])


def _circle(image: ImageArray, centre_px: tuple[float, float], radius_px: float, colour: tuple[int, int, int]) -> None:
    scale = 2**SUBPIXEL_BITS
    centre = (round(scale * centre_px[0]), round(scale * centre_px[1]))
    cv2.circle(image, centre, round(scale * (radius_px + 2.0)), colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def _row(image: ImageArray, v_px: float, colour: tuple[int, int, int]) -> None:
    scale, width = 2**SUBPIXEL_BITS, image.shape[1]
    v = round(scale * v_px)
    cv2.line(image, (0, v), (scale * (width - 1), v), colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def _write(image: ImageArray, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """Write text on a filled background."""
    (width, height), _ = cv2.getTextSize(text, FONT, LETTERS, 1)
    x, y = max(at[0], 2), max(at[1], height + 2)
    cv2.rectangle(image, (x - 2, y - height - 3), (x + width + 2, y + 4), BLACK, -1)
    cv2.putText(image, text, (x, y), FONT, LETTERS, colour, 1, cv2.LINE_AA)
