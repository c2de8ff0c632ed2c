"""Lens model of a camera: project directions to the image, and image points back to directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from bodyschema.interfaces.records import FloatArray

Model = Literal["pinhole", "fisheye", "rational"]

# k1, k2, p1, p2, k3 of the radial and tangential model; k1 to k4 of Kannala & Brandt 2006; the radial and tangential
# model over 1 + k4 r² + k5 r⁴ + k6 r⁶. The simpler ones stand first.
DISTORTION_NAMES: dict[Model, tuple[str, ...]] = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}


class LensSettings:
    """Settings of the inverse of a lens, and of its examination.

    Sensitivity: each of the inverse at 0.3 and 3 times changes no calibration of six sets of views.
    """

    iterations, converged = 30, 1e-12  # steps of Newton's method; a smaller step ends it [focal lengths]
    widest_rad = 1.5  # off the axis, beyond which a fisheye's polynomial says nothing
    min_slope = 0.05  # lower bound of the derivative: keeps steps short where a lens folds over
    # The largest x/z and y/z that a rectified image shows: beyond them a fisheye's image would be stretched too much.
    widest = 1.2
    rays = 64  # number of rays from the axis on which a lens is examined, and of points on each


@dataclass(frozen=True)
class Lens:
    """OpenCV's pinhole model with five coefficients, its fisheye model with four, or its rational model with eight."""

    model: Model  # which of them
    focal_px: tuple[float, float]  # (fx, fy)
    principal_point_px: tuple[float, float]  # (cx, cy); integer coordinates are pixel centres
    distortion: tuple[float, ...]  # in the order of `DISTORTION_NAMES`

    @classmethod
    def from_vector(cls, model: Model, values: ArrayLike) -> Lens:
        """Create the lens with these values, in the order of `vector`."""
        fx, fy, cx, cy, *distortion = np.asarray(values, dtype=np.float64).tolist()
        return cls(model, (fx, fy), (cx, cy), tuple(distortion))

    @property
    def vector(self) -> FloatArray:
        """fx, fy, cx, cy and the distortion."""
        return np.array([*self.focal_px, *self.principal_point_px, *self.distortion])

    @property
    def matrix(self) -> FloatArray:
        """The camera matrix, shape (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_px, self.principal_point_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, x: FloatArray) -> FloatArray:
        """Project points (n, 3) in the eye's frame (x right, y down, z forward) to image coordinates (n, 2) [px]."""
        return self.project_posed(x, np.zeros(3), np.zeros(3))[0]

    def project_posed(
        self, x: FloatArray, rotation: FloatArray, translation: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Project points of a posed frame to the image, with derivatives by the pose and the lens parameters.

        Args:
            x: points, shape (n, 3).
            rotation, translation: the frame's pose in the eye's frame as rotation vector [rad] and position, (3,) each.

        Returns:
            Image coordinates (n, 2) [px]; their derivatives (2n, 6) by rotation and translation, and (2n, p) by
            `vector`, with u and v of one point in neighbouring rows.
        """
        points, distortion = np.ascontiguousarray(x, dtype=np.float64).reshape(-1, 1, 3), np.array(self.distortion)
        if self.model != "fisheye":
            seen = cv2.projectPoints(points, rotation, translation, self.matrix, distortion)
            px, J = (np.asarray(each, dtype=np.float64) for each in seen[:2])
            return px.reshape(-1, 2), J[:, :6], J[:, 6 : 10 + len(distortion)]
        seen = cv2.fisheye.projectPoints(points, rotation, translation, self.matrix, distortion)
        px, J = (np.asarray(each, dtype=np.float64) for each in seen[:2])
        return px.reshape(-1, 2), J[:, 8:14], J[:, :8]

    def directions(self, px: FloatArray) -> FloatArray:
        """Return directions (n, 2) as (x/z, y/z) of image points (n, 2) [px], by Newton's method."""
        px = np.reshape(np.asarray(px, dtype=np.float64), (-1, 2))
        flat = (px - np.array(self.principal_point_px)) / np.array(self.focal_px)
        if self.model == "fisheye":
            seen = np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
            return flat / seen * np.tan(self._angle(seen))
        return self._undistorted(flat, px)

    def is_one_to_one(self, image_size_px: tuple[int, int]) -> bool:
        """Return False if the lens folds over within the image, so that one image point shows two directions.

        Far from the axis a distortion polynomial folds over; a fit to corners does not keep this out of the image.
        Directions beyond `widest` do not count.
        """
        turn = 2.0 * np.pi * np.arange(LensSettings.rays) / LensSettings.rays
        across = LensSettings.widest / np.maximum(np.abs(np.cos(turn)), np.abs(np.sin(turn)))
        rays = np.stack([np.cos(turn), np.sin(turn)], axis=1) * across[:, None]
        ahead = np.linspace(0.0, 1.0, LensSettings.rays)[:, None, None] * rays
        px = self.project(np.concatenate([ahead, np.ones((*ahead.shape[:2], 1))], axis=2).reshape(-1, 3))
        px = px.reshape(*ahead.shape[:2], 2)
        outward = np.sum(np.diff(px, axis=0) * rays, axis=2) > 0.0
        inside = np.all((px[:-1] >= 0.0) & (px[:-1] <= np.array(image_size_px) - 1.0), axis=2)
        # Only the part of a ray before it first leaves the image counts.
        return bool(np.all(outward | ~np.logical_and.accumulate(inside, axis=0)))

    def _angle(self, seen: FloatArray) -> FloatArray:
        """Return the angle off the axis [rad] for a distance from the principal point in focal lengths."""
        # Kannala & Brandt 2006, eq. (6)
        powers = np.array([3, 5, 7, 9])
        k = np.array(self.distortion)
        angle = np.minimum(seen, LensSettings.widest_rad)
        for _ in range(LensSettings.iterations):
            value = angle + (angle[..., None] ** powers) @ k
            slope = 1.0 + (angle[..., None] ** (powers - 1)) @ (k * powers)
            moved = np.clip(
                angle - (value - seen) / np.maximum(slope, LensSettings.min_slope), 0.0, LensSettings.widest_rad
            )
            done = np.max(np.abs(moved - angle), initial=0.0) < LensSettings.converged
            angle = moved
            if done:
                break
        return angle

    def _undistorted(self, start: FloatArray, px: FloatArray) -> FloatArray:
        found = start
        h = 1e-6
        shifts = h * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        for _ in range(LensSettings.iterations):
            ahead = np.column_stack([found, np.ones(len(found))])
            value, right, down = self.project((ahead + shifts[:, None]).reshape(-1, 3)).reshape(3, -1, 2)
            (a, c), (b, d) = ((right - value) / h).T, ((down - value) / h).T
            u, v = (value - px).T
            # Where a lens folds the image over, there is no direction; the short step only keeps the result finite.
            determinant = np.maximum(a * d - b * c, LensSettings.min_slope * self.focal_px[0] * self.focal_px[1])
            step = np.column_stack([d * u - b * v, a * v - c * u]) / determinant[:, None]
            found = found - step
            if np.max(np.abs(step), initial=0.0) < LensSettings.converged:
                break
        return found
