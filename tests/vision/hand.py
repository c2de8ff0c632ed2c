"""Skin-coloured fingers around a ball."""

from __future__ import annotations

import cv2
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray

SKIN_RGB = (0.72, 0.48, 0.38)
_FINGERS, _FINGER_PX, _LENGTH = 3, 0.45, 4.0
# OpenCV draws with this many bits of sub-pixels.
_BITS = 4


def paint_fingers(
    picture: FloatArray, x_eye: FloatArray, radius_m: float, turn: float, reach: float, calibration: StereoCalibration
) -> FloatArray:
    """Paint three fingers on `picture` (RGB of 0..1) that come from the direction `turn` [rad].

    Args:
        reach: distance of their tips from the ball's centre, in radii: above 1 they stay clear of it.
    """
    painted = picture.astype(np.float64, copy=True)
    centre = calibration.project(x_eye)[:2]
    radius_px = calibration.focal_px * radius_m / float(x_eye[2])
    width = max(1, round(2 * _FINGER_PX * radius_px))
    for number in range(_FINGERS):
        angle = turn + 0.75 * (number - 1)
        direction = np.array([np.cos(angle), np.sin(angle)])
        # A thick line ends in a half circle around its tip.
        tip = centre + direction * (reach * radius_px + width / 2)
        root = centre + direction * _LENGTH * radius_px
        ends = [tuple(np.rint(end * 2**_BITS).astype(int).tolist()) for end in (tip, root)]
        shade = 0.85 + 0.1 * number
        cv2.line(painted, *ends, tuple(shade * level for level in SKIN_RGB), width, cv2.LINE_AA, _BITS)
    return painted
