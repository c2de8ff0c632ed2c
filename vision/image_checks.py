"""Check a tracker's images and their calibration."""

from __future__ import annotations

import math

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError, SourceError
from bodyschema.interfaces.records import ImageArray, StereoFrame


class ImageSettings:
    white, max_white = 250, 0.4  # grey level of an over-exposed pixel, and the largest share of them in a usable image
    black = 20  # grey level that hardly a pixel of a black image exceeds


def check_images(frame: StereoFrame, calibration: StereoCalibration) -> None:
    """Raise SourceError if the images are not uint8 BGR of the calibration's size."""
    width, height = calibration.image_size_px
    if len(frame.images) != len(calibration.eyes_m):
        raise SourceError(
            f"frames with {len(frame.images)} images for each instant, but the calibration is of "
            f"{len(calibration.eyes_m)}. Fix [camera] eyes, or [vision.cameras]"
        )
    names = ("left image", "right image") if calibration.is_stereo else ("image",)
    for name, image in zip(names, frame.images, strict=True):
        if image.shape != (height, width, 3) or image.dtype != np.uint8:
            raise SourceError(
                f"the {name} is {_described(image)}; the calibration is for {width}x{height} pixels of three "
                "colours (uint8, BGR). Set the camera to that size, or fix [camera] image_size_px"
            )


def _described(image: ImageArray) -> str:
    size = f"{image.shape[1]}x{image.shape[0]} pixels" if image.ndim in (2, 3) else f"an array of shape {image.shape}"
    colours = f" of {image.shape[2]} channels" if image.ndim == 3 else " of grey" if image.ndim == 2 else ""
    return f"{size}{colours} ({image.dtype})"


def check_calibration(calibration: StereoCalibration) -> None:
    """Raise ConfigError unless the calibration describes a stereo pair or one camera."""
    width, height = calibration.image_size_px
    if not (math.isfinite(calibration.focal_px) and calibration.focal_px > 0):
        raise ConfigError(f"[camera] focal_px is {calibration.focal_px}", remedy="It has to be a number above 0")
    if not (math.isfinite(calibration.baseline_m) and calibration.baseline_m >= 0):
        raise ConfigError(f"[camera] baseline_m is {calibration.baseline_m}", remedy="It has to be 0 or more")
    if not (math.isfinite(calibration.pixel_sigma) and calibration.pixel_sigma >= 0):
        raise ConfigError(f"[camera] pixel_sigma is {calibration.pixel_sigma}", remedy="It has to be 0 or more")
    if not all(math.isfinite(value) for value in calibration.principal_point_px):
        raise ConfigError(f"[camera] principal_point_px is {calibration.principal_point_px}", remedy="Give two numbers")
    if min(width, height) < 16:
        raise ConfigError(f"[camera] image_size_px is {width}x{height}", remedy="16x16 is the least")


def is_black(image: ImageArray) -> bool:
    """Return True if the whole image is dark."""
    return bool(np.quantile(image, 0.99) < ImageSettings.black)


def too_white(levels: ImageArray) -> float | None:
    """Return the share of white among grey levels, if it is too large."""
    white = float(np.mean(levels >= ImageSettings.white))
    return white if white > ImageSettings.max_white else None
