"""Calibrated cameras as the ideal pinholes used everywhere else: two side by side, or a single one."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import StereoEyes
from bodyschema.interfaces.records import FloatArray, ImageArray, StereoFrame

from .lens import Lens, LensSettings
from .stereo_rig import CalibrationError, OneEyeRig, Rig


@dataclass(frozen=True, eq=False)
class Rectification:
    """Rectification of both eyes' images to those of two parallel pinhole cameras side by side.

    The origin of the rectified left frame is the left eye's optical centre. It is the left camera's own frame rotated
    by `R_rectified_left`: its x axis points to the right eye, and its z axis is as near as possible to the mean viewing
    direction of both cameras. Nothing is translated and no length changes. The frame of a single camera is its own.
    """

    rig: Rig  # the calibration

    @cached_property
    def R_rectified_left(self) -> FloatArray:
        """Rotation (3, 3) of directions from the left camera's own frame to the rectified one."""
        if isinstance(self.rig, OneEyeRig):
            return np.eye(3)
        R, t = self.rig.R_right_left, self.rig.translation_m
        x = -R.T @ t / np.linalg.norm(t)
        ahead = np.array([0.0, 0.0, 1.0]) + R.T @ np.array([0.0, 0.0, 1.0])
        y = np.cross(ahead, x)
        y /= np.linalg.norm(y)
        return np.stack([x, y, np.cross(x, y)])

    @property
    def eyes(self) -> tuple[tuple[Lens, FloatArray], ...]:
        """Lens and rotation of each eye, the left one first."""
        left = self.rig.left, self.R_rectified_left
        if isinstance(self.rig, OneEyeRig):
            return (left,)
        return left, (self.rig.right, self.R_rectified_left @ self.rig.R_right_left.T)

    @cached_property
    def calibration(self) -> StereoCalibration:
        """The pinholes: the largest view in which all eyes fill every pixel.

        Its `pixel_sigma` is the error of held-out views, at the rectified focal length.

        Raises:
            CalibrationError: the eyes share no view, or a lens folds over within its image.
        """
        width, height = self.rig.image_size_px
        low, high = self._common_view()
        if np.any(high - low < 0.1):
            raise CalibrationError(self._why_no_view())
        focal = float(max((width - 1) / (high[0] - low[0]), (height - 1) / (high[1] - low[1])))
        centre = 0.5 * np.array([width - 1, height - 1]) - 0.5 * focal * (low + high)
        mean_focal_px = float(np.mean([lens.focal_px for lens, _ in self.eyes]))
        return StereoCalibration(
            focal_px=focal,
            principal_point_px=(float(centre[0]), float(centre[1])),
            baseline_m=0.0 if isinstance(self.rig, OneEyeRig) else self.rig.baseline_m,
            image_size_px=self.rig.image_size_px,
            pixel_sigma=self.rig.provenance.held_out_px * focal / mean_focal_px,
        )

    def points(self, px: FloatArray, eye: int) -> FloatArray:
        """Return the rectified image points (n, 2) [px] of an eye's (0 left, 1 right) points (n, 2) [px]."""
        calibration = self.calibration
        return calibration.focal_px * self.directions(px, eye) + np.array(calibration.principal_point_px)

    def directions(self, px: FloatArray, eye: int) -> FloatArray:
        """Return the rectified directions (x/z, y/z) of an eye's image points, shape (n, 2)."""
        lens, R = self.eyes[eye]
        return _rotated(lens.directions(px), R)

    def maps(self, eye: int) -> tuple[ImageArray, ImageArray]:
        """Return OpenCV's fixed-point maps that rectify the images of an eye (0 left, 1 right)."""
        lens, R = self.eyes[eye]
        calibration = self.calibration
        width, height = calibration.image_size_px
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        px = np.stack([u.ravel(), v.ravel()], axis=1)
        ahead = (px - np.array(calibration.principal_point_px)) / calibration.focal_px
        raw_px = lens.project(np.column_stack([ahead, np.ones(len(ahead))]) @ R)
        x, y = (raw_px[:, k].reshape(height, width).astype(np.float32) for k in range(2))
        return cv2.convertMaps(x, y, cv2.CV_16SC2)  # pyright: ignore

    def _why_no_view(self) -> str:
        if not all(lens.is_one_to_one(self.rig.image_size_px) for lens, _ in self.eyes):
            return (
                f"the {self.rig.model} lens model folds over within the image. Calibrate again, with the board in the "
                "image's corners too"
            )
        angle_deg = np.degrees(np.arccos(np.clip(self.eyes[-1][1][2] @ self.eyes[0][1][2], -1.0, 1.0)))
        return f"the cameras share almost no view: their lines of sight are {angle_deg:.0f}° apart. Turn them parallel"

    def _common_view(self) -> tuple[FloatArray, FloatArray]:
        """Return the limits (x/z, y/z) of the largest upright rectangle that all eyes' images fill."""
        views = [_inscribed_view(lens, R, self.rig.image_size_px) for lens, R in self.eyes]
        low = np.max([view[0] for view in views], axis=0)
        return low, np.min([view[1] for view in views], axis=0)


def _inscribed_view(lens: Lens, R: FloatArray, size_px: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the limits (x/z, y/z) of an upright rectangle that one eye's image fills."""
    width, height = size_px
    along = np.linspace(0.0, 1.0, LensSettings.rays)
    ends = np.zeros_like(along)
    sides = [
        np.column_stack([x * (width - 1), y * (height - 1)])
        for x, y in ((ends, along), (along, ends), (ends + 1.0, along), (along, ends + 1.0))
    ]
    left, top, right, bottom = (
        np.clip(_rotated(lens.directions(side), R), -LensSettings.widest, LensSettings.widest) for side in sides
    )
    low = np.array([left[:, 0].max(), top[:, 1].max()])
    return low, np.array([right[:, 0].min(), bottom[:, 1].min()])


def _rotated(directions: FloatArray, R: FloatArray) -> FloatArray:
    turned = np.column_stack([directions, np.ones(len(directions))]) @ R.T
    return turned[:, :2] / turned[:, 2:]


class RectifiedCamera:
    """The rectified images of calibrated cameras: a `StereoCamera`."""

    def __init__(self, eyes: StereoEyes, rig: Rig) -> None:
        """Compute the maps. Opening the cameras checks that they are the calibrated ones.

        Raises:
            CalibrationError: the calibrated eyes share no view, or a lens folds over within its image.
        """
        self._eyes, self._rig = eyes, rig
        rectification = Rectification(rig)
        self._calibration = rectification.calibration
        self._maps = [rectification.maps(eye) for eye in range(len(rectification.eyes))]
        self._open = False

    @property
    def calibration(self) -> StereoCalibration:
        """The pinholes of the rectified images."""
        return self._calibration

    def __enter__(self) -> Self:
        """Open the cameras; raise OtherCameras, a SourceError, if they are not the calibrated ones."""
        self._eyes.__enter__()
        try:
            self._rig.require(self._eyes.image_size_px, self._eyes.serials)
        except BaseException:
            self._eyes.__exit__(None, None, None)
            raise
        if not all(self._rig.serials):
            logging.getLogger(__name__).warning("the calibration does not say which cameras it is of: taken as these")
        self._open = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open = False
        self._eyes.__exit__(kind, error, trace)

    def read(self, timeout_s: float) -> StereoFrame | None:
        """Return the next frame, rectified; None if none came within `timeout_s`."""
        if not self._open:
            raise SourceError("the camera is not open")
        frame = self._eyes.read(timeout_s)
        if frame is None:
            return None
        images = [self._rectified(image, eye) for eye, image in enumerate(frame.images)]
        return StereoFrame(frame.t, images[0], images[1] if len(images) > 1 else None, frame.t_sigma)

    def _rectified(self, image: ImageArray, eye: int) -> ImageArray:
        if image.shape[1::-1] != self._rig.image_size_px:
            raise SourceError(
                f"an image of {image.shape[1]}x{image.shape[0]}, calibrated was "
                f"{self._rig.image_size_px[0]}x{self._rig.image_size_px[1]}. Set that size"
            )
        return cv2.remap(image, *self._maps[eye], cv2.INTER_LINEAR)  # pyright: ignore
