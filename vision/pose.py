"""Maximum-likelihood pose of a rigid body whose points are seen by one eye or two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.linalg import block_diag

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray

from .least_squares import damped_step, minimised


@dataclass(frozen=True, slots=True)
class Sighting:
    """Measurements by one eye of some points of the body."""

    points: FloatArray  # positions in the body's frame (k, 3) [m]
    pixels: FloatArray  # image coordinates (k, 2) [px]
    cov_px: FloatArray  # covariance (2k, 2k) [px²] of u and v of the first, then of the second point
    right: bool  # True for the right eye
    # 1-sigma (k, 2), or (1, 2), [px] of an error that the points of all sightings have in common
    shared_px: FloatArray = field(default_factory=lambda: np.zeros((1, 2)))


@dataclass(frozen=True, slots=True)
class Pose:
    """A pose in the left optical frame, with the covariance of its error."""

    rotation: FloatArray  # (3, 3), from the body's frame to the optical frame
    x: FloatArray  # the body's origin (3,) [m]
    cov: FloatArray  # covariance (6, 6) of a small turn about the axes of the optical frame [rad], then of x [m]
    squares: float  # sum of the squared residuals in units of their sigmas


@dataclass(frozen=True, slots=True)
class _Linearised:
    """Residuals at a pose, and their derivative by rotation and position, in units of sigma."""

    rotation: FloatArray
    x: FloatArray
    residuals: FloatArray
    jacobian: FloatArray

    @property
    def squares(self) -> float:
        return float(self.residuals @ self.residuals)


class PoseEstimator:
    """Maximum-likelihood estimator over the pixels of all eyes, with Gaussian errors.

    `pixel_sigma` of the calibration is the error of rectification near the body: one shift for each eye, which all its
    points share.
    """

    def __init__(self, calibration: StereoCalibration, sightings: Sequence[Sighting]) -> None:
        self._calibration = calibration
        self._eyes = [_merged(sightings, right) for right in (False, True) if any(s.right == right for s in sightings)]
        self._roots = [whitening(eye.cov_px, calibration.pixel_sigma) for eye in self._eyes]
        whitened = [root @ eye.shared_px.ravel() for eye, root in zip(self._eyes, self._roots, strict=True)]
        self._shared = np.concatenate(whitened)
        square = 1.0 + float(self._shared @ self._shared)
        self._shrink = 1.0 / (square + math.sqrt(square))

    def refine(self, rotation: FloatArray, x: FloatArray) -> Pose | None:
        """Return the least-squares pose near an initial one; None if the body is not in front of the eyes.

        Levenberg-Marquardt on the rotation about the origin of the body and on the origin's position.
        """
        first = self._linearised(rotation, x)
        if first is None:
            return None
        found = minimised(first, self._stepped)
        cov = np.asarray(np.linalg.inv(found.jacobian.T @ found.jacobian), dtype=np.float64)
        return Pose(found.rotation, found.x, cov, found.squares)

    def _stepped(self, now: _Linearised, damping: float) -> _Linearised | None:
        change = damped_step(now.jacobian, now.residuals, damping)
        turn = np.asarray(cv2.Rodrigues(change[:3])[0], np.float64)
        return self._linearised(turn @ now.rotation, now.x + change[3:])

    def size_error(self, pose: Pose) -> tuple[float, float]:
        """Return the relative size error of the body against its nominal size, and its 1-sigma.

        One more Gauss-Newton step with the size free: the eyes' distance against the printed size.
        """
        linear = self._linearised(pose.rotation, pose.x)
        if linear is None:
            return math.inf, 0.0
        by_size = self._whitened([self._by_size(eye, pose).ravel() for eye in self._eyes])
        full = np.column_stack([linear.jacobian, by_size])
        cov = np.linalg.inv(full.T @ full)
        return float((cov @ full.T @ linear.residuals)[6]), math.sqrt(cov[6, 6])

    def bent(self, pose: Pose, heights: FloatArray) -> Pose:
        """Return the pose of a plate that may be bent, with a covariance that includes its confusion with a bend.

        It takes one more Gauss-Newton step with free bends, whose prior variances are their estimated second moments.

        Args:
            pose: pose of a flat plate.
            heights: each bend's heights (k, m) [m] at the points, all of which every eye sees.
        """
        linear = self._linearised(pose.rotation, pose.x)
        if linear is None:
            return pose
        bends = [self._by_height(eye, pose)[..., None] * heights[:, None] for eye in self._eyes]
        by_bending = self._whitened([each.reshape(-1, heights.shape[1]) for each in bends])
        full = np.column_stack([linear.jacobian, by_bending])
        cov = np.linalg.inv(full.T @ full)
        amounts = (cov @ full.T @ linear.residuals)[6:]
        full[:, 6:] *= np.sqrt(amounts**2 + np.diag(cov)[6:])
        cov = np.asarray(np.linalg.inv(full.T @ full + np.diag([0.0] * 6 + [1.0] * len(amounts))), np.float64)
        change = cov @ full.T @ linear.residuals
        remaining = linear.residuals - full @ change
        turn = np.asarray(cv2.Rodrigues(change[:3])[0], np.float64)
        squares = float(remaining @ remaining + change[6:] @ change[6:])
        return Pose(turn @ pose.rotation, pose.x + change[3:6], cov[:6, :6], squares)

    def _by_height(self, eye: Sighting, pose: Pose) -> FloatArray:
        """Return the derivative of an eye's pixels by the height of its points along the body's z (k, 2)."""
        points = eye.points @ pose.rotation.T + self._in_eye(pose.x, eye)
        return projection_jacobian(self._calibration.focal_px, points) @ pose.rotation[:, 2]

    def _by_size(self, eye: Sighting, pose: Pose) -> FloatArray:
        """Return the derivative of an eye's pixels by the body's size (k, 2)."""
        arms = eye.points @ pose.rotation.T
        return (projection_jacobian(self._calibration.focal_px, arms + self._in_eye(pose.x, eye)) @ arms[..., None])[
            ..., 0
        ]

    def _in_eye(self, x: FloatArray, sighting: Sighting) -> FloatArray:
        return x - np.array([self._calibration.baseline_m, 0.0, 0.0]) if sighting.right else x

    def _linearised(self, rotation: FloatArray, x: FloatArray) -> _Linearised | None:
        residuals, jacobians = [], []
        for eye in self._eyes:
            arms = eye.points @ rotation.T
            points = arms + self._in_eye(x, eye)
            if (points[:, 2] <= 0.0).any():
                return None
            projection = projection_jacobian(self._calibration.focal_px, points)
            by_turn = projection @ turn_jacobian(arms)
            seen = self._calibration.focal_px * points[:, :2] / points[:, 2:] + self._calibration.principal_point_px
            residuals.append((eye.pixels - seen).ravel())
            jacobians.append(np.concatenate([by_turn, projection], axis=2).reshape(-1, 6))
        return _Linearised(rotation, x, self._whitened(residuals), self._whitened(jacobians))

    def _whitened(self, eyes: Sequence[FloatArray]) -> FloatArray:
        """Return all eyes' values with independent errors of sigma 1: by C^-1/2 with C = 1 + their common part."""
        values = np.concatenate([root @ each for root, each in zip(self._roots, eyes, strict=True)])
        return values - np.multiply.outer(self._shrink * self._shared, self._shared @ values)


def _merged(sightings: Sequence[Sighting], right: bool) -> Sighting:
    """Return one eye's sighting of all points."""
    seen = [sighting for sighting in sightings if sighting.right == right]
    points, pixels = np.concatenate([s.points for s in seen]), np.concatenate([s.pixels for s in seen])
    shared = np.concatenate([np.broadcast_to(s.shared_px, s.pixels.shape) for s in seen])
    return Sighting(points, pixels, np.asarray(block_diag(*(s.cov_px for s in seen))), right, shared)


def projection_jacobian(focal_px: float, points: FloatArray) -> FloatArray:
    """Return the derivative (k, 2, 3) [px/m] of the pixels of points (k, 3) in an eye's frame."""
    rows = np.zeros((len(points), 2, 3))
    scale = focal_px / points[:, 2]
    rows[:, 0, 0] = rows[:, 1, 1] = scale
    rows[:, :, 2] = -scale[:, None] * points[:, :2] / points[:, 2:]
    return rows


def whitening(cov_px: FloatArray, pixel_sigma: float) -> FloatArray:
    """Return the matrix that makes an eye's pixel residuals, u and v in turn, independent and of sigma 1.

    Args:
        cov_px: their own covariance (2k, 2k) [px²].
        pixel_sigma: 1-sigma of a shift of each coordinate that they all share [px].
    """
    shared = np.tile(np.eye(2), (len(cov_px) // 2, 1))
    cov = cov_px + pixel_sigma**2 * shared @ shared.T
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), dtype=np.float64)


def turn_jacobian(arms: FloatArray) -> FloatArray:
    """Return matrices (k, 3, 3) with ω × arm = −[arm]× ω for arms (k, 3) under a small rotation ω."""
    matrices = np.zeros((len(arms), 3, 3))
    x, y, z = arms.T
    matrices[:, 0, 1], matrices[:, 0, 2] = z, -y
    matrices[:, 1, 0], matrices[:, 1, 2] = -z, x
    matrices[:, 2, 0], matrices[:, 2, 1] = y, -x
    return matrices


def angle_between(one: FloatArray, other: FloatArray) -> float:
    """Return the angle [rad] of the rotation from one orientation (3, 3) to another."""
    return 2.0 * math.asin(min(float(np.linalg.norm(one - other)) / math.sqrt(8.0), 1.0))


def mirrored(rotation: FloatArray, x: FloatArray) -> FloatArray:
    """Return the other rotation (3, 3) under which a small plane at x (3,) looks nearly the same.

    A plane's image without perspective does not show to which side it is tilted: a rotation by 180° about the line of
    sight and by 180° about the plane's own normal gives nearly the same image.
    """
    sight = x / np.linalg.norm(x)
    about_sight = 2.0 * np.outer(sight, sight) - np.eye(3)
    return about_sight @ rotation @ np.diag([-1.0, -1.0, 1.0])


def fitted_motion(body: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation (3, 3) and origin (3,) that best map points of the body (k, 3) to observed points (k, 3).

    Kabsch 1976.
    """
    middle_body, middle_seen = body.mean(axis=0), seen.mean(axis=0)
    u, _, vt = np.linalg.svd((seen - middle_seen).T @ (body - middle_body))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation, middle_seen - rotation @ middle_body


def initial_poses(
    calibration: StereoCalibration, points: FloatArray, pixels: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the poses, as rotation (3, 3) and origin (3,) [m], with which `points` project near `pixels`.

    Least squares of the points' distances from their rays in space, without an initial guess (SQPnP: Terzakis and
    Lourakis 2020). The list is empty if there is no solution.

    Args:
        points: points of a body in its own frame (k, 3) [m].
        pixels: their image coordinates (k, 2) [px].
    """
    rays = (pixels - np.array(calibration.principal_point_px)) / calibration.focal_px
    found, turns, places, _ = cv2.solvePnPGeneric(
        points, rays[:, None], np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_SQPNP
    )
    if not found:
        return []
    return [
        (np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.ravel(np.asarray(place, np.float64)))
        for turn, place in zip(turns, places, strict=True)
    ]
