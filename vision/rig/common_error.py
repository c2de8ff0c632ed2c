"""Position errors that all fixes of calibrated cameras share: from the lenses, the eyes' poses, and sizes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.pose import turn_jacobian

from .lens import Lens
from .rectified import Rectification
from .stereo_rig import Rig, StereoRig


class CommonErrorSettings:
    # Distance of the positions that decide which turn of the frame is no error, and that are taken for typical [m].
    ahead_m = 0.6
    nearest_m = 0.1 * ahead_m  # nearer, the two eyes of a pair share no view
    grid_points = 9  # points across the image, and down
    step = 1e-3  # of a direction, for the growth of a small marker


@dataclass(frozen=True, eq=False)
class CommonError:
    """Errors of positions in the rectified left frame that no number of fixes averages out.

    They do not include a rotation of the whole frame about the left eye: the calibration itself defines the direction
    of the frame.
    """

    rig: Rig  # the calibration
    size_sigma: float = 0.0  # relative 1-sigma of the marker's size, from which one eye derives all distances

    def require_usable(self) -> None:
        """Raise CalibrationError if the eyes share no view, or a lens folds over within its image."""
        _ = self._frame

    def errors(self, x: FloatArray) -> FloatArray:
        """Return the errors (n, 3, k) [m] at positions x (n, 3) [m], at 1 sigma of each of k independent unknowns."""
        x = self._within_view(x)
        return self._raw(x) - turn_jacobian(x) @ self._frame

    def variance(self, x: FloatArray) -> FloatArray:
        """Return the variance (n, 3) [m²] of each coordinate at positions x (n, 3) [m]."""
        return np.square(self.errors(x)).sum(axis=2)

    @cached_property
    def typical(self) -> FloatArray:
        """1-sigma of each coordinate (3,) [m] at `ahead_m`: the RMS over the view."""
        return np.asarray(np.sqrt(self.variance(self._grid).mean(axis=0)), np.float64)

    @cached_property
    def _grid(self) -> FloatArray:
        """Positions all over the view (n, 3) [m]."""
        across, down = np.meshgrid(*np.linspace(self._view[0], self._view[1], CommonErrorSettings.grid_points).T)
        return CommonErrorSettings.ahead_m * np.column_stack([across.ravel(), down.ravel(), np.ones(across.size)])

    @cached_property
    def _rectification(self) -> Rectification:
        return Rectification(self.rig)

    @cached_property
    def _root(self) -> FloatArray:
        """Root (p, k) of the calibration's covariance, without rounding errors."""
        sigma = self.rig.sigma
        values, vectors = np.linalg.eigh(self.rig.covariance / np.outer(sigma, sigma))
        kept = values > 1e-9 * values[-1]
        return np.asarray(sigma[:, None] * vectors[:, kept] * np.sqrt(values[kept]), np.float64)

    @cached_property
    def _frame(self) -> FloatArray:
        """Rotation (3, k) [rad] of the frame for each unknown: the best fit over the view, after `turn_jacobian`."""
        errors = self._raw(self._grid)
        turn = np.linalg.lstsq(turn_jacobian(self._grid).reshape(-1, 3), errors.reshape(-1, errors.shape[2]))[0]
        return np.asarray(turn, np.float64)

    @cached_property
    def _view(self) -> FloatArray:
        """Lowest and highest x/z and y/z (2, 2) in the rectified images."""
        pinhole = self._rectification.calibration
        corners = np.array([[0.0, 0.0], np.array(pinhole.image_size_px) - 1.0])
        return np.asarray((corners - pinhole.principal_point_px) / pinhole.focal_px, np.float64)

    def _within_view(self, x: FloatArray) -> FloatArray:
        """Return positions x (n, 3), each moved into the cameras' view, since models may predict outside it."""
        ahead = np.maximum(x[:, 2:], CommonErrorSettings.nearest_m)
        return np.concatenate([ahead * np.clip(x[:, :2] / ahead, *self._view), ahead], axis=1)

    def _raw(self, x: FloatArray) -> FloatArray:
        R = self._rectification.R_rectified_left
        own = _by_two_eyes(self.rig, x @ R) if isinstance(self.rig, StereoRig) else _by_one_eye(self.rig.left, x)
        errors = R @ own @ self._root
        return np.concatenate([errors, self.size_sigma * x[:, :, None]], axis=2) if self.size_sigma else errors


def _by_two_eyes(rig: StereoRig, x: FloatArray) -> FloatArray:
    """Return the derivative (n, 3, p) of triangulated points x (n, 3) in the left eye's frame by the rig's vector."""
    _, by_left, by_left_lens = rig.left.project_posed(x, np.zeros(3), np.zeros(3))
    _, by_pose, by_right_lens = rig.right.project_posed(x, rig.rotation_rad, rig.translation_m)
    n, p = len(x), by_left_lens.shape[1]
    by_x = np.concatenate(
        [by_left[:, 3:].reshape(n, 2, 3), (by_pose[:, 3:] @ rig.R_right_left).reshape(n, 2, 3)], axis=1
    )
    by_rig = np.zeros((n, 4, 2 * p + 6))
    by_rig[:, :2, :p] = by_left_lens.reshape(n, 2, p)
    by_rig[:, 2:, p:] = np.concatenate([by_right_lens, by_pose], axis=1).reshape(n, 2, p + 6)
    return np.asarray(-np.linalg.solve(by_x.mT @ by_x, by_x.mT @ by_rig), np.float64)


def _by_one_eye(lens: Lens, x: FloatArray) -> FloatArray:
    """Return the derivative (n, 3, p) by the lens of positions x (n, 3) of a small marker of known size.

    The marker's direction moves with the lens, and its distance shrinks as its image grows. If two sides of an image
    grow differently, this looks like a tilt. The side that determines the distance depends on the tilt; the mean is
    taken.
    """
    seen = x[:, None, :2] / x[:, None, 2:]
    steps = CommonErrorSettings.step * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    moved = _moved(lens, (seen + steps).reshape(-1, 2)).reshape(len(x), len(steps), 2, -1)
    spread = (moved[:, 1, 0] - moved[:, 2, 0] + moved[:, 3, 1] - moved[:, 4, 1]) / (2.0 * CommonErrorSettings.step)
    # Growth of the solid angle, from that in the image plane and the length of (x/z, y/z, 1).
    outward = (seen @ moved[:, 0])[:, 0] / (1.0 + np.square(seen).sum(axis=2))
    growth = 0.5 * (spread - outward)
    ahead = np.concatenate([seen[:, 0], np.ones((len(x), 1))], axis=1)
    across = np.concatenate([moved[:, 0], np.zeros((len(x), 1, moved.shape[3]))], axis=1)
    return np.asarray(x[:, 2, None, None] * (across - ahead[:, :, None] * growth[:, None]), np.float64)


def _moved(lens: Lens, seen: FloatArray) -> FloatArray:
    """Return the derivative (n, 2, p) by the lens of the directions (n, 2) seen at fixed pixels."""
    ahead = np.column_stack([seen, np.ones(len(seen))])
    _, by_pose, by_lens = lens.project_posed(ahead, np.zeros(3), np.zeros(3))
    by_direction, by_lens = by_pose[:, 3:5].reshape(-1, 2, 2), by_lens.reshape(len(seen), 2, -1)
    return np.asarray(-np.linalg.solve(by_direction, by_lens), np.float64)
