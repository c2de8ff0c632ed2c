"""What is drawn into the images is what the tracker looks for."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from interfaces.camera import StereoCalibration
from interfaces.records import MarkerFix, StereoFrame
from vision.cameras.annotate import Annotator
from vision.config import VisionConfig

CAMERAS = StereoCalibration(
    focal_px=700.0, principal_point_px=(160.0, 120.0), baseline_m=0.12, image_size_px=(320, 240), pixel_sigma=0.2
)
AT = (160, 120)


def disc(bgr: tuple[int, int, int]) -> np.ndarray:
    """A disc of this colour before dark grey, softened as a lens does it."""
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
def test_what_is_marked_is_of_the_marker_that_is_looked_for(config, bgr, seen) -> None:
    assert len(Annotator(CAMERAS, config).sights(disc(bgr))) == seen


@pytest.mark.parametrize(("marker", "circled"), [("tag", False), ("ball", True)])
def test_a_ball_is_circled_and_a_tag_is_not(marker, circled) -> None:
    grey = np.full((240, 320, 3), 40, dtype=np.uint8)
    fix = MarkerFix(t=0.0, x=np.array([0.0, 0.0, 0.5]), cov=1e-8 * np.eye(3), centres_px=(160.0, 120.0, 100.0, 120.0))
    above = AT[1] - round(700.0 * VisionConfig().radius_m / 0.5) - 2
    drawn = Annotator(CAMERAS, VisionConfig(marker=marker)).drawn(StereoFrame(0.0, grey, grey), fix)
    assert bool((drawn[above - 1 : above + 2, AT[0]] != 40).any()) == circled
