"""Render the robot from one eye: TinyRenderer on a grid of samples at exact image positions.

Integer image coordinates are pixel centres. TinyRenderer samples column i of a frustum at its left edge plus i, row j
at its top edge plus j + 1 (measured), so the frustum is shifted to align the samples with the pixel centres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray

_NEAR_M, _FAR_M = 0.05, 8.0
# Optical frame (x right, y down, z forward) to OpenGL's eye frame (x right, y up, z backward).
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Grid:
    """Samples over a rectangle of the image."""

    # left, top: the first whole pixel
    left: int
    top: int
    # columns, rows: number of samples
    columns: int
    rows: int
    per_pixel: float  # samples across one pixel (a half: one sample in two pixels)

    def directions(self, calibration: StereoCalibration) -> FloatArray:
        """Return the rays (rows, columns, 3) through the samples, with z = 1."""
        cx, cy = calibration.principal_point_px
        u = self.left - 0.5 + (np.arange(self.columns) + 0.5) / self.per_pixel
        v = self.top - 0.5 + (np.arange(self.rows) + 0.5) / self.per_pixel
        rays = np.ones((self.rows, self.columns, 3))
        rays[..., 0] = (u - cx) / calibration.focal_px
        rays[..., 1] = ((v - cy) / calibration.focal_px)[:, None]
        return rays

    def projection(self, bullet: Any, calibration: StereoCalibration) -> list[float]:
        """Return the OpenGL projection matrix with which TinyRenderer samples exactly at the grid's positions."""
        cx, cy = calibration.principal_point_px
        half = 0.5 / self.per_pixel
        u = self.left - 0.5 + half
        v = self.top - 0.5 - half
        scale = _NEAR_M / calibration.focal_px
        width, height = self.columns / self.per_pixel, self.rows / self.per_pixel
        return bullet.computeProjectionMatrix(
            left=(u - cx) * scale,
            right=(u + width - cx) * scale,
            bottom=-(v + height - cy) * scale,
            top=-(v - cy) * scale,
            nearVal=_NEAR_M,
            farVal=_FAR_M,
        )


class Raster:
    """Renderer of one pybullet world.

    Args:
        to_light: unit vector to the light in the world (3,).
    """

    def __init__(self, bullet: Any, client: int, calibration: StereoCalibration, to_light: FloatArray) -> None:
        self._bullet, self._client, self._calibration = bullet, client, calibration
        self._to_light = to_light.tolist()

    def render(self, T_world_eye: FloatArray, grid: Grid) -> tuple[ImageArray, FloatArray]:
        """Return colours (rows, columns, 3), BGR, and depths along z (rows, columns) [m]; inf without a hit."""
        view = _FLIP @ np.linalg.inv(T_world_eye)
        _, _, rgba, buffer, _ = self._bullet.getCameraImage(
            grid.columns,
            grid.rows,
            viewMatrix=view.T.ravel().tolist(),
            projectionMatrix=grid.projection(self._bullet, self._calibration),
            lightDirection=self._to_light,
            lightAmbientCoeff=0.6,
            lightDiffuseCoeff=0.4,
            lightSpecularCoeff=0.05,
            shadow=0,
            flags=self._bullet.ER_NO_SEGMENTATION_MASK,
            renderer=self._bullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        empty = buffer >= 1.0
        depth = 2 * _NEAR_M * _FAR_M / (_FAR_M + _NEAR_M - (2.0 * buffer - 1.0) * (_FAR_M - _NEAR_M))
        depth[empty] = np.inf
        return rgba[..., 2::-1], depth


class EmptyWorld:
    """Renderer of an empty world, with the interface of `Raster`; needs no pybullet."""

    def render(self, T_world_eye: FloatArray, grid: Grid) -> tuple[ImageArray, FloatArray]:  # noqa: ARG002
        """Return black colours (rows, columns, 3), and depths (rows, columns) of inf."""
        return np.zeros((grid.rows, grid.columns, 3), np.uint8), np.full((grid.rows, grid.columns), np.inf)
