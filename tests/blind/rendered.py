"""Fixes from images: the ball is cast through the true lenses onto pixels, and the product's tracker looks for it.

The images share nothing with the simulation's renderer. Of the product only the tracker is taken, as the instrument.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import MarkerFix, StereoFrame
from bodyschema.vision.ball.tracker import StereoTracker

from .arrays import BoolArray, FloatArray
from .eyes import TrueEyes

BALL_RADIUS_M = 0.02
BALL_BGR = np.array([18.0, 20.0, 215.0])
TO_LIGHT = np.array([-0.3, -0.8, -0.5]) / np.linalg.norm([-0.3, -0.8, -0.5])
AMBIENT = 0.6
SUPERSAMPLING = 4
NOISE_GREY, NOISE_FIELDS = 5.0, 2
PIXEL_SIGMA = 0.02  # about the tracker's accuracy on these images
AROUND_PX = 6
APART_S = 10.0  # between frames for the tracker: pairs are looked at singly, without its memory


class Studio:
    """Renderer of the true cameras' images."""

    def __init__(self, eyes: TrueEyes, rng: np.random.Generator) -> None:
        self._eyes, self._rng = eyes, rng
        width, height = eyes.described.image_size_px
        blotches = gaussian_filter(rng.standard_normal((2, height, width), dtype=np.float32), (0, 25, 25), mode="wrap")
        grey = 120.0 + 25.0 * blotches / blotches.std()
        tint = np.array([1.05, 1.0, 0.97])
        self._rooms = np.clip(grey[..., None] * tint, 0.0, 255.0)
        self._noise = NOISE_GREY * rng.standard_normal((NOISE_FIELDS, height, width, 3), dtype=np.float32)
        self._empty = [[_grey_levels(room + noise) for noise in self._noise] for room in self._rooms]

    def frame(self, t: float, x: FloatArray) -> StereoFrame:
        """Return both images of a ball at `x` (3,) [m] in the true left optical frame."""
        turn = Rotation.from_euler("y", self._eyes.vergence_rad).as_matrix()
        in_right = (x - np.array([self._eyes.baseline_m, 0.0, 0.0])) @ turn
        return StereoFrame(t, self._image(0, x), self._image(1, in_right))

    def _image(self, eye: int, centre: FloatArray) -> NDArray[np.uint8]:
        field = int(self._rng.integers(NOISE_FIELDS))
        image = self._empty[eye][field].copy()
        left, top, right, bottom = self._window(centre)
        if right > left and bottom > top:
            window = (slice(top, bottom), slice(left, right))
            image[window] = _grey_levels(
                self._with_ball(self._rooms[eye][window], left, top, centre) + self._noise[field][window]
            )
        return image

    def _with_ball(self, room: FloatArray, left: int, top: int, centre: FloatArray) -> FloatArray:
        """Return the part of the image at (left, top) with the ball in it, averaged over the samples of each pixel."""
        rows, columns = room.shape[:2]
        inside = (np.arange(SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5
        u = (left + np.arange(columns)[:, None] + inside).ravel()
        v = (top + np.arange(rows)[:, None] + inside).ravel()
        rays = self._rays(*np.meshgrid(u, v))
        along = rays @ centre
        hit = along**2 - centre @ centre + BALL_RADIUS_M**2
        near = along - np.sqrt(np.maximum(hit, 0.0))
        normal = (rays * near[..., None] - centre) / BALL_RADIUS_M
        light = AMBIENT + (1.0 - AMBIENT) * np.maximum(normal @ TO_LIGHT, 0.0)
        behind = room.repeat(SUPERSAMPLING, 0).repeat(SUPERSAMPLING, 1)
        samples = np.where((hit > 0.0)[..., None], light[..., None] * BALL_BGR, behind)
        return samples.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING, 3).mean(axis=(1, 3))

    def _rays(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Return unit directions of the rays that the true lens images at points [px]."""
        bent = (np.stack([u, v], axis=-1) - self._eyes.described.principal_point_px) / self._eyes.focal_px
        ideal = bent
        for _ in range(12):
            r2 = np.sum(ideal**2, axis=-1, keepdims=True)
            ideal = bent / (1.0 + self._eyes.k1 * r2 + self._eyes.k2 * r2**2)
        rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def _window(self, centre: FloatArray) -> tuple[int, int, int, int]:
        """Return left, top, right, bottom [px] of a window inside the image that contains the ball."""
        straight = TrueEyes(self._eyes.described, self._eyes.focal_px, 0.0, self._eyes.k1, self._eyes.k2)
        at = straight.project(centre[None])[0, :2]
        reach = 1.6 * self._eyes.focal_px * BALL_RADIUS_M / (centre[2] - BALL_RADIUS_M) + AROUND_PX
        low = np.maximum(np.floor(at - reach), 0).astype(int)
        high = np.minimum(np.ceil(at + reach), self._eyes.described.image_size_px).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _grey_levels(image: FloatArray) -> NDArray[np.uint8]:
    return np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)


def tracked(eyes: TrueEyes, at: FloatArray, rng: np.random.Generator) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Track the ball in rendered images of balls at (n, 3) [m] in the true left optical frame.

    Returns:
        Which were found (n,), their positions (n, 3) [m] and covariances (n, 3, 3) [m²]; NaN where none was found.
    """
    described = eyes.described
    calibration = StereoCalibration(
        described.focal_px,
        described.principal_point_px,
        described.baseline_m,
        described.image_size_px,
        described.pixel_sigma,
    )
    studio, tracker = Studio(eyes, rng), StereoTracker(calibration)
    x, covariance = np.full((len(at), 3), np.nan), np.full((len(at), 3, 3), np.nan)
    for index, point in enumerate(at):
        tracker.forget()
        fix = tracker.track(studio.frame(APART_S * index, point))
        if isinstance(fix, MarkerFix):
            x[index], covariance[index] = fix.x, fix.cov
    return np.isfinite(x[:, 0]), x, covariance
