"""Annotations in the images agree with the marker that the tracker looks for."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from ball_renderer import SMALL, Look
from tag_renderer import Sheet, photograph

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import MarkerFix, StereoFrame
from bodyschema.vision.cameras.annotate import GREEN, RED, Annotator
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tags.config import TagConfig
from bodyschema.vision.trackers import tracker_of

CAMERAS = StereoCalibration(
    focal_px=700.0, principal_point_px=(160.0, 120.0), baseline_m=0.12, image_size_px=(320, 240), pixel_sigma=0.2
)
AT = (160, 120)


def disc(bgr: tuple[int, int, int]) -> np.ndarray:
    """Return a disc of this colour on dark grey, blurred as by a lens."""
    image = np.full((240, 320, 3), 40, dtype=np.uint8)
    cv2.circle(image, AT, 20, bgr, -1, cv2.LINE_AA)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


@pytest.mark.parametrize(
    ("config", "bgr", "seen"),
    [
        (VisionConfig(), (30, 30, 200), 1),
        (VisionConfig(colour="green"), (30, 30, 200), 0),
        (VisionConfig(marker="bright_ball"), (235, 235, 235), 1),
        (VisionConfig(marker="tag"), (30, 30, 200), 0),
    ],
)
def test_only_the_configured_marker_is_annotated(config, bgr, seen) -> None:
    assert len(Annotator(CAMERAS, config).sights(disc(bgr))) == seen


@pytest.mark.parametrize(("marker", "circled"), [("tag", False), ("ball", True)])
def test_ball_is_circled_and_tag_is_not(marker, circled) -> None:
    grey = np.full((240, 320, 3), 40, dtype=np.uint8)
    fix = MarkerFix(t=0.0, x=np.array([0.0, 0.0, 0.5]), cov=1e-8 * np.eye(3), centres_px=(160.0, 120.0, 100.0, 120.0))
    above = AT[1] - round(700.0 * VisionConfig().radius_m / 0.5) - 2
    annotated = Annotator(CAMERAS, VisionConfig(marker=marker)).annotated(StereoFrame(0.0, grey, grey), fix)
    assert bool((annotated[above - 1 : above + 2, AT[0]] != 40).any()) == circled


FACING = np.diag([1.0, -1.0, -1.0])


def shown(ids: tuple[int, ...], wanted: int) -> tuple[np.ndarray, MarkerFix | None]:
    """Return the left half of the picture of tags side by side, one of which is wanted, and the fix."""
    tags = [Sheet(id, FACING, np.array([0.06 * k - 0.02, 0.0, 0.5]), 0.04) for k, id in enumerate(ids)]
    frame = photograph(tags, SMALL, Look(wall=0.4, samples=2), np.random.default_rng(0))
    config = VisionConfig(marker="tag", tag=TagConfig(id=wanted, side_m=0.04))
    seen = tracker_of(SMALL, config).track(frame)
    picture = Annotator(SMALL, config).annotated(frame, seen)
    return picture[30:, : SMALL.image_size_px[0]], seen if isinstance(seen, MarkerFix) else None


def has(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - colour).max(axis=2) < 12).any())


def test_found_tag_is_outlined_at_its_fix() -> None:
    picture, fix = shown((3,), wanted=3)
    assert fix is not None
    corner = SMALL.project(np.array([-0.04, -0.02, 0.5]))[:2].round().astype(int) - (0, 30)
    assert has(picture[corner[1] - 3 : corner[1] + 4, corner[0] - 3 : corner[0] + 4], GREEN)


def test_unwanted_tag_is_outlined_in_red() -> None:
    picture, fix = shown((7,), wanted=3)
    assert fix is None
    assert has(picture, RED)
    assert not has(picture, GREEN)
