"""Project a sphere into a pinhole camera: an ellipse whose centre is not the image of the sphere's centre.

The rays that touch a sphere form a circular cone around the direction of its centre, with half-angle
γ = asin(radius / distance). The image plane cuts that cone in an ellipse whose major axis points away from the
principal point. With θ the angle between that direction and the optical axis and D = cos²γ − sin²θ:

    centre of the ellipse   f · sinθ cosθ / D     from the principal point (the sphere's centre: f · tanθ)
    major semi-axis         f · sinγ cosγ / D
    minor semi-axis         f · sinγ / √D
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray

# A cone that reaches past 80° from the optical axis has no usable image.
_LARGEST_ANGLE = math.radians(80.0)


@dataclass(frozen=True, slots=True)
class Ellipse:
    """Image of a sphere."""

    centre_px: FloatArray  # centre of the ellipse, shape (2,) [px]
    radius_px: float  # radius of the circle of the same area [px]
    # symmetric matrix of determinant 1, shape (2, 2), that turns the circle of that radius into the ellipse
    shape: FloatArray


@dataclass(frozen=True, slots=True)
class Pinhole:
    """One eye: focal length [px] and principal point [px]."""

    focal_px: float
    principal_point_px: tuple[float, float]

    def outline(self, x_eye: FloatArray, radius_m: float) -> Ellipse | None:
        """Return the outline of a sphere around `x_eye` (3,) [m] in this eye's frame; None if it is not in front of
        the eye.
        """
        x, y, z = x_eye.tolist()
        across, distance = math.hypot(x, y), math.hypot(x, y, z)
        if not (z > 0 and distance > radius_m):
            return None
        gamma = math.asin(radius_m / distance)
        theta = math.acos(min(1.0, z / distance))
        if theta + gamma > _LARGEST_ANGLE:
            return None
        spread = math.cos(gamma) ** 2 - math.sin(theta) ** 2
        u, v = (x / across, y / across) if across > 0 else (1.0, 0.0)
        off_px = self.focal_px * math.sin(theta) * math.cos(theta) / spread
        u0, v0 = self.principal_point_px
        major = self.focal_px * math.sin(gamma) * math.cos(gamma) / spread
        minor = self.focal_px * math.sin(gamma) / math.sqrt(spread)
        shape = _stretch(u, v, math.sqrt(major / minor))
        return Ellipse(np.array([u0 + u * off_px, v0 + v * off_px]), math.sqrt(major * minor), shape)

    def distance_over_radius(self, centre_px: FloatArray, radius_px: float) -> float:
        """Return the approximate distance, in sphere radii, of a sphere whose outline has this centre and radius."""
        tan_theta = math.dist(centre_px, self.principal_point_px) / self.focal_px
        # For small γ the ellipse has the area π f² sin²γ / cos³θ.
        cos_theta = 1.0 / math.hypot(1.0, tan_theta)
        sin_gamma = radius_px / self.focal_px * cos_theta**1.5
        return 1.0 / min(sin_gamma, 0.9)

    def sphere_centre(self, centre_px: FloatArray, distance_over_radius: float) -> FloatArray:
        """Return the image (2,) [px] of a sphere's centre whose outline is centred at `centre_px` (2,) [px].

        Args:
            distance_over_radius: distance of the sphere's centre from the eye in units of its radius.
        """
        tan_ellipse = math.dist(centre_px, self.principal_point_px) / self.focal_px
        if tan_ellipse == 0.0:
            return centre_px
        # With T = tanθ and s = sin²γ the centre lies at T / (1 − s(1 + T²)); solved for T, stably for small s.
        s = distance_over_radius**-2
        a = tan_ellipse * s
        root = math.sqrt(max(0.0, 1.0 + 4.0 * a * tan_ellipse * (1.0 - s)))
        tan_theta = 2.0 * tan_ellipse * (1.0 - s) / (1.0 + root)
        return self.principal_point_px + (centre_px - self.principal_point_px) * (tan_theta / tan_ellipse)

    def shape(self, centre_px: FloatArray) -> FloatArray:
        """Return the shape (2, 2) of the outline of a small sphere seen at `centre_px` (2,) [px]."""
        u, v = (centre_px - self.principal_point_px).tolist()
        off_px = math.hypot(u, v)
        direction = (u / off_px, v / off_px) if off_px > 0 else (1.0, 0.0)
        return _stretch(*direction, math.sqrt(math.hypot(1.0, off_px / self.focal_px)))


def _stretch(u: float, v: float, factor: float) -> FloatArray:
    more, less = factor - 1.0 / factor, 1.0 / factor
    return np.array([[less + more * u * u, more * u * v], [more * u * v, less + more * v * v]])
