"""Weights of the corners in the joint fit.

Corners are found to 0.01 px where squares are large, and to 0.1 px where they are small or seen obliquely: far away,
and towards the border of a fisheye image, which determines its lens. With equal weights, the accurate corners would
have too little influence. The variance of a corner is therefore estimated from the residuals of corners whose squares
are equally wide, multiplied by the relative level of its own image's residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.records import FloatArray

from .bundle import Bundle, solve
from .influence import influences
from .settings import FitSettings as _Settings
from .view import View

# A squared distance in the plane over twice the coordinate variance is exponential; this is the median.
_MEDIAN = np.log(2.0)


@dataclass(frozen=True)
class _Spread:
    """Spread of all corners: variance from their own residuals [px²], width of their squares, and their image."""

    own: FloatArray
    width: FloatArray
    image: NDArray[np.int64]

    def typical(self, share: FloatArray, kept: NDArray[np.bool_], *, robust: bool) -> FloatArray:
        """Return the variance of corners by the width of their squares, relative to their image's level."""
        order = np.flatnonzero(kept)[np.argsort(self.width[kept], kind="stable")]
        groups = np.array_split(order, max(len(order) // _Settings.group, 1))
        left = self.own / share
        level = [float(np.median(left[each])) / _MEDIAN if robust else float(left[each].mean()) for each in groups]
        falling = np.asarray(isotonic_regression(level, increasing=False).x, dtype=np.float64)
        middle = [float(np.median(np.log(self.width[each]))) for each in groups]
        return np.exp(np.interp(np.log(self.width), middle, np.log(np.maximum(falling, 1e-12))))

    def image_factors(self, typical: FloatArray, kept: NDArray[np.bool_]) -> FloatArray:
        """Return the variance of each corner's image relative to the usual one."""
        is_kept = kept.astype(np.float64)
        count, total = np.bincount(self.image, is_kept), np.bincount(self.image, is_kept * self.own / typical)
        return ((total + _Settings.shared) / (count + _Settings.shared))[self.image]

    def inliers(self, typical: FloatArray) -> NDArray[np.bool_]:
        """Return the mask of the corners that are not outliers."""
        fits = np.ones(len(self.own), dtype=bool)
        for number in range(int(self.image.max()) + 1):
            rows = np.flatnonzero(self.image == number)
            relative = self.own[rows] / typical[rows]
            fits[rows] = relative <= 0.5 * _Settings.farthest**2 * max(float(np.median(relative)) / _MEDIAN, 1.0)
        return fits


def corner_weights(views: Sequence[View], corners_m: FloatArray, bundle: Bundle) -> tuple[FloatArray, ...]:
    """Return the weights of each view's corners after a fit, the left eye's before the right one's; 0 for outliers.

    The mean over all corners is 1, so that weighted residuals remain pixels.
    """
    spread = _spread(views, corners_m, bundle)
    everything = np.ones(len(spread.own), dtype=bool)
    typical = spread.typical(np.ones(len(spread.own)), everything, robust=True)
    kept = spread.inliers(typical)
    typical = spread.typical(spread.image_factors(typical, kept), kept, robust=False)
    weights = np.where(kept, 1.0 / (typical * spread.image_factors(typical, kept)), 0.0)
    weights /= weights.mean()
    return tuple(np.split(weights, np.cumsum([view.corner_count for view in views])[:-1]))


def refit_weighted(views: Sequence[View], corners_m: FloatArray, bundle: Bundle) -> Bundle:
    """Refit with weights that follow the accuracy of each image's corners."""
    for _ in range(_Settings.reweighted):
        weights = corner_weights(views, corners_m, bundle)
        bundle = solve(views, corners_m, bundle.model, bundle.vector, bundle.poses, weights, bundle.prior)
    return bundle


def _spread(views: Sequence[View], corners_m: FloatArray, bundle: Bundle) -> _Spread:
    own, width, image = [], [], []
    for k, (view, pose, each) in enumerate(zip(views, bundle.poses, influences(views, corners_m, bundle), strict=True)):
        own.append(0.5 * np.sum(each.residual**2, axis=1) / each.remaining_share)
        # Pixels per step along the board's axes, and from them the width of a square in its narrower direction.
        steps = each.by_pose[:, 3:].reshape(-1, 2, 3) @ Rotation.from_rotvec(pose[:3]).as_matrix()[:, :2]
        width.append(1.0 / np.linalg.norm(np.linalg.inv(steps), axis=2).max(axis=1))
        left = 0 if view.left is None else len(view.left)
        image.append(2 * k + (np.arange(len(each.residual)) >= left))
    numbers = np.unique(np.concatenate(image), return_inverse=True)[1]
    return _Spread(np.concatenate(own), np.concatenate(width), numbers.astype(np.int64))
