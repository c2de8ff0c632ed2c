"""Triangulation of two image points of a rectified pair, with covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.ball.blob import Disc
from bodyschema.vision.ball.sphere import Pinhole


@dataclass(frozen=True, slots=True)
class Location:
    """The measured position of a ball."""

    x: FloatArray  # its centre in the left optical frame, shape (3,) [m]
    cov: FloatArray  # covariance of x, shape (3, 3) [m²]
    centres_px: FloatArray  # image of its centre as (ul, vl, ur, vr), shape (4,) [px]
    variances_px: FloatArray  # variances of `centres_px`, shape (4,) [px²]
    level: float  # brightness of the marker's colour on it, mean of the eyes [grey levels]
    # deviation of the limbs from their ellipses, geometric mean of the two discs', in variances of their samples
    roughness: float
    radii_px: FloatArray  # of the two discs, shape (2,) [px]
    # sizes, size_sigmas: the radii relative to those expected at this depth, and the 1-sigma of that due to the images,
    # shape (2,) each
    sizes: FloatArray
    size_sigmas: FloatArray


def triangulate(
    calibration: StereoCalibration, centres_px: FloatArray, variances_px: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Triangulate the point seen at `centres_px` (ul, vl, ur, vr) [px] with `variances_px` (4,) [px²].

    Returns:
        The most likely point (3,) [m] in the left optical frame and its covariance (3, 3) [m²], to first order;
        None if the rays do not meet in front of the eyes.
    """
    ul, vl, ur, vr = centres_px.tolist()
    disparity = ul - ur
    if not disparity > 0:
        return None
    cx, cy = calibration.principal_point_px
    share_left = variances_px[3] / (variances_px[1] + variances_px[3])
    share_right = 1.0 - share_left
    depth_per_px = calibration.baseline_m / disparity
    off = np.array([ul - cx, share_left * vl + share_right * vr - cy, calibration.focal_px])
    x = depth_per_px * off
    by_disparity = -depth_per_px / disparity * off
    # Columns: derivatives by ul, vl, ur, vr.
    jacobian = np.zeros((3, 4))
    jacobian[:, 0], jacobian[:, 2] = by_disparity, -by_disparity
    jacobian[0, 0] += depth_per_px
    jacobian[1, 1], jacobian[1, 3] = depth_per_px * share_left, depth_per_px * share_right
    return x, (jacobian * variances_px) @ jacobian.T


def locate(calibration: StereoCalibration, radius_m: float, left: Disc, right: Disc) -> Location | None:
    """Locate the ball of `radius_m` whose images are the two discs.

    Return None if the rays do not meet far enough in front of the eyes for both to see the ball.

    The shift between the sphere's centre and the ellipse's depends on the distance: the distance from the size is used
    first, then the triangulated one.
    """
    eye = Pinhole(calibration.focal_px, calibration.principal_point_px)
    variances = np.concatenate([left.cov_px.diagonal(), right.cov_px.diagonal()]) + calibration.pixel_sigma**2
    distances = [eye.distance_over_radius(disc.centre_px, disc.radius_px) for disc in (left, right)]
    rough = _centres(eye, left, right, distances)
    point = triangulate(calibration, rough, variances)
    if point is None:
        return None
    to_right_eye = np.array([calibration.baseline_m, 0.0, 0.0])
    distances = [max(1.1, math.hypot(*x) / radius_m) for x in (point[0], point[0] - to_right_eye)]
    centres = _centres(eye, left, right, distances)
    point = triangulate(calibration, centres, variances)
    outlines = [] if point is None else [eye.outline(x, radius_m) for x in (point[0], point[0] - to_right_eye)]
    expected_px = [outline.radius_px for outline in outlines if outline is not None]
    if point is None or len(expected_px) < len(outlines):
        return None
    radii_px = np.array([left.radius_px, right.radius_px])
    return Location(
        *point,
        centres_px=centres,
        variances_px=variances,
        level=(left.level + right.level) / 2,
        roughness=math.sqrt(left.roughness * right.roughness),
        radii_px=radii_px,
        sizes=radii_px / expected_px,
        size_sigmas=np.array([left.radius_sigma_px, right.radius_sigma_px]) / radii_px,
    )


def _centres(eye: Pinhole, left: Disc, right: Disc, distances_over_radius: list[float]) -> FloatArray:
    one, other = distances_over_radius
    return np.concatenate([eye.sphere_centre(left.centre_px, one), eye.sphere_centre(right.centre_px, other)])
