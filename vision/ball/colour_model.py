"""Learn a ball's colour from a pixel in one image, or from the ball's motion through several."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.records import FloatArray, ImageArray
from bodyschema.vision.config import HueBand
from bodyschema.vision.image_file import read_image

from .settings import ColourSettings as _Settings


class ColourUnlearnt(BodyschemaError):
    """Error for images that do not show a ball of one colour at the expected position."""

    def __init__(self, what: str, *, remedy: str = "") -> None:
        super().__init__(f"{what}{f'. {remedy}' if remedy else ''}")


def colour_at(image: ImageArray, u: float, v: float) -> HueBand:
    """Return the hue band of the ball that covers the pixel (u, v) of a BGR image (height, width, 3).

    Raises:
        ColourUnlearnt: the pixel is outside the image, or its surroundings are grey, black or white.
    """
    height, width = image.shape[:2]
    column, row = round(u), round(v)
    if not (0 <= column < width and 0 <= row < height):
        raise ColourUnlearnt(f"({u:g}, {v:g}) is outside the image of {width}x{height} pixels")
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    near = hsv[
        max(row - _Settings.seed_px, 0) : row + _Settings.seed_px + 1,
        max(column - _Settings.seed_px, 0) : column + _Settings.seed_px + 1,
    ]
    seed = _colourful(near.reshape(-1, 3))
    if len(seed) < near.shape[0] * near.shape[1] // 2:
        raise ColourUnlearnt(
            f"at ({u:g}, {v:g}) there is no colour, only grey, black or white",
            remedy='Click on the middle of the ball, beside its highlight. A ball without colour is a "bright_ball"',
        )
    middle = _mean_hue_deg(seed)
    similar = (_hue_difference_deg(hsv[..., 0] * 2.0, middle) < _Settings.hues_of_a_click_deg) & _is_colourful(hsv)
    _, labels = cv2.connectedComponents(similar.astype(np.uint8), connectivity=4)
    label = labels[row, column]
    pixels = hsv[labels == label] if label else seed
    return _band(_colourful(pixels))


def colour_of_the_moving(images: Iterable[ImageArray]) -> HueBand:
    """Return the hue band of the one colourful object that moves through BGR images of a fixed camera.

    Pixels are weighted by their saturation, because the hand moves too and skin is paler than a marker.

    Raises:
        ColourUnlearnt: fewer than three images, or nothing colourful moves.
    """
    frames = list(images)
    if len(frames) < 3:
        raise ColourUnlearnt(f"a motion needs three images or more, not {len(frames)}")
    background = np.median(np.stack(frames[:: max(1, len(frames) // 15)]), axis=0).astype(np.uint8)
    moved = [_colourful(_moving_pixels(frame, background)) for frame in frames]
    pixels = np.concatenate(moved)
    if len(pixels) < _Settings.min_pixels * len(frames):
        raise ColourUnlearnt(
            "nothing colourful moves in these images", remedy="Move the ball across the view, and keep the camera still"
        )
    weight = (pixels[:, 1].astype(np.float64) / 255.0) ** 4
    counts = np.bincount(pixels[:, 0], weights=weight, minlength=180)
    smooth = np.convolve(np.concatenate([counts[-5:], counts, counts[:5]]), np.hanning(11), mode="valid")
    peak_deg = 2.0 * int(np.argmax(smooth))
    return _band(pixels[_hue_difference_deg(pixels[:, 0] * 2.0, peak_deg) < _Settings.hues_of_a_click_deg])


def read_images(files: Sequence[Path]) -> list[ImageArray]:
    """Return the BGR images of `files`; raise ColourUnlearnt for one that is unreadable or differs in size."""
    images: list[ImageArray] = []
    for file in files:
        image = read_image(file)
        if image is None:
            raise ColourUnlearnt(f"{file} is no image that can be read")
        images.append(image)
        if image.shape != images[0].shape:
            raise ColourUnlearnt(f"{file} has another size than {files[0]}", remedy="Give images of one camera")
    return images


def colour_table(band: HueBand) -> str:
    """Return the table [vision.colour] of robot.toml."""
    return (
        "[vision.colour]\n"
        f"hue_deg = {band.hue_deg:.1f}\n"
        f"half_width_deg = {band.half_width_deg:.1f}\n"
        f"min_saturation = {band.min_saturation:.2f}\n"
        f"min_value = {band.min_value:.2f}\n"
    )


def _moving_pixels(frame: ImageArray, background: ImageArray) -> ImageArray:
    changed = (cv2.absdiff(frame, background).max(axis=2) > _Settings.changed).astype(np.uint8)
    changed = cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)[changed > 0].astype(np.uint8)


def _is_colourful(hsv: np.ndarray) -> np.ndarray:
    return (hsv[..., 1] >= _Settings.min_saturation) & (hsv[..., 2] >= _Settings.min_value)


def _colourful(pixels: np.ndarray) -> ImageArray:
    return pixels[_is_colourful(pixels)]


def _mean_hue_deg(pixels: ImageArray) -> float:
    angles = np.deg2rad(pixels[:, 0] * 2.0)
    return float(np.rad2deg(np.angle(np.exp(1j * angles).mean()))) % 360.0


def _hue_difference_deg(hue_deg: NDArray[np.floating], other_deg: float) -> FloatArray:
    return np.abs((hue_deg - other_deg + 180.0) % 360.0 - 180.0).astype(np.float64)


def _band(pixels: ImageArray) -> HueBand:
    """Return the band around the pixels' hues (n, 3 of HSV), with a margin for other light."""
    middle = _mean_hue_deg(pixels)
    reach = (
        float(np.quantile(_hue_difference_deg(pixels[:, 0] * 2.0, middle), 1.0 - 2 * _Settings.share))
        + _Settings.margin_deg
    )
    saturation, value = (float(np.quantile(pixels[:, channel], 2 * _Settings.share)) / 255.0 for channel in (1, 2))
    return HueBand(
        hue_deg=round(middle, 1) % 360.0,
        half_width_deg=round(reach, 1),
        min_saturation=round(_Settings.dimmer_saturation * saturation, 2),
        min_value=round(_Settings.dimmer_value * value, 2),
    )
