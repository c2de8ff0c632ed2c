"""Joint least-squares problem of both eyes: lenses, the right eye's pose, and the board's pose in every view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.least_squares import minimised
from bodyschema.vision.rig.lens import Lens, Model
from bodyschema.vision.rig.stereo_rig import CalibrationError, lenses_of

from .view import EYES, View

POSE = 6
UNDETERMINED = "the views do not determine the lenses. Take more views, tilted and all over the image"


@dataclass(frozen=True)
class Bundle:
    """A solution."""

    model: Model  # the lenses' model
    vector: FloatArray  # the rig's parameters, as `StereoRig.vector` has them
    # the board's pose in the left eye's frame for each view, as rotation vector [rad] and position [m], shape (views,
    # 6)
    poses: FloatArray
    # per view, measured minus predicted, shape (corners, 2) [px], the left eye's before the right one's
    residuals: tuple[FloatArray, ...]
    # per view and corner, shape (corners,), of `corner_weights`; 0 for rejected corners
    weights: tuple[FloatArray, ...]
    normal: FloatArray  # the normal matrix of `vector` with the poses eliminated, for residuals of 1 px
    prior: FloatArray  # precision of each parameter about 0 before the views, in the same units, shape (p,); 0: none

    @property
    def kept(self) -> tuple[FloatArray, ...]:
        """Residuals of each view without the rejected corners."""
        return tuple(each[w > 0.0] for each, w in zip(self.residuals, self.weights, strict=True))

    @property
    def freedom(self) -> int:
        """Degrees of freedom: image coordinates minus unknowns."""
        return sum(each.size for each in self.kept) - len(self.vector) - self.poses.size

    @property
    def sigma_px(self) -> float:
        """1-sigma of an image coordinate: the RMS residual over all views [px]."""
        return float(np.sqrt(sum(np.sum(each**2) for each in self.kept) / max(self.freedom, 1)))

    def view_rms_px(self) -> FloatArray:
        """Return the RMS residual per image coordinate of each view [px]."""
        return np.array([np.sqrt(np.mean(each**2)) for each in self.kept])


def solve(
    views: Sequence[View],
    corners_m: FloatArray,
    model: Model,
    vector: FloatArray,
    poses: FloatArray,
    weights: Sequence[FloatArray] | None = None,
    prior: FloatArray | None = None,
) -> Bundle:
    """Solve the least-squares problem from a start by the Levenberg-Marquardt method.

    Args:
        corners_m: the board's corners, shape (n, 3) [m].
        vector, poses: the start, as in `Bundle`.
        weights: as in `Bundle`; None for equal weights.
        prior: as in `Bundle`; None for no prior.

    Raises:
        CalibrationError: the views do not determine the parameters.
    """
    corner_weights = tuple(np.ones(view.corner_count) for view in views) if weights is None else tuple(weights)
    prior = np.zeros(len(vector)) if prior is None else prior

    def stepped(now: Linear, damping: float) -> Linear | None:
        step = now.step(damping)
        if step is None:
            return None
        return _linearised(views, corners_m, model, now.vector + step[0], now.poses + step[1], corner_weights, prior)

    linear = minimised(_linearised(views, corners_m, model, vector, poses, corner_weights, prior), stepped)
    if not np.isfinite(linear.squares):
        raise CalibrationError(UNDETERMINED)
    return Bundle(
        model, linear.vector, linear.poses, tuple(linear.residuals), corner_weights, linear.reduced(0.0)[0], prior
    )


def view_residuals(
    view: View, corners_m: FloatArray, model: Model, vector: FloatArray, start: FloatArray, weights: FloatArray
) -> FloatArray:
    """Return a view's residuals for a fixed rig, with the best-fitting board pose, shape (corners, 2) [px].

    Args:
        start: the pose to start from, shape (6,).
        weights: corner weights, shape (corners,).
    """

    def stepped(now: Linear, damping: float) -> Linear:
        H = now.pose_normals[0]
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)), now.pose_gradients[0])
        return _linearised([view], corners_m, model, vector, now.poses + step, [weights])

    return minimised(_linearised([view], corners_m, model, vector, start[None], [weights]), stepped).residuals[0]


def residuals_and_jacobian(
    view: View, corners_m: FloatArray, lenses: Sequence[Lens], right_eye: FloatArray, pose: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a view's residuals (corners, 2) [px] and the Jacobian of the prediction (2 corners, p + 6).

    The Jacobian has two rows a corner, u and v. Its columns are those of the rig's vector, then of the board's pose.

    Args:
        lenses: of one eye, or of the left and the right one.
        right_eye: the end of the rig's vector behind the lenses: the right eye's pose, shape (6,), or nothing.
        pose: the board's pose in the left eye's frame, shape (6,).
    """
    residuals, slopes = [], []
    for number, eye in enumerate(EYES):
        corners = view.eye(eye)
        if corners is None:
            continue
        rotation, translation, by_rig, by_pose = pose[:3], pose[3:], None, None
        if eye == "right":
            rotation, translation, by_rig, by_pose = _in_right_eye(pose, right_eye)
        px, J_pose, J_lens = lenses[number].project_posed(corners_m[corners.numbers], rotation, translation)
        n = J_lens.shape[1]
        J = np.zeros((len(J_lens), n * len(lenses) + len(right_eye) + POSE))
        J[:, number * n : (number + 1) * n] = J_lens
        if by_rig is not None:
            J[:, -2 * POSE : -POSE] = J_pose @ by_rig
        J[:, -POSE:] = J_pose if by_pose is None else J_pose @ by_pose
        residuals.append(corners.px - px)
        slopes.append(J)
    return np.concatenate(residuals), np.concatenate(slopes)


def split_lenses(model: Model, vector: FloatArray) -> tuple[tuple[Lens, ...], FloatArray]:
    """Return the lenses in the rig's vector, and the values behind them."""
    lenses = lenses_of(model, vector)
    return lenses, vector[len(lenses) * len(lenses[0].vector) :]


def _in_right_eye(pose: FloatArray, right_eye: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return a pose in the right eye's frame, and its Jacobians by the right eye's pose and by the given pose."""
    composed = cv2.composeRT(pose[:3], pose[3:], right_eye[:3], right_eye[3:])
    r, t, r_r1, r_t1, r_r2, r_t2, t_r1, t_t1, t_r2, t_t2 = (np.asarray(each, dtype=np.float64) for each in composed)
    by_rig, by_pose = np.empty((2, POSE, POSE))
    by_rig[:3, :3], by_rig[:3, 3:], by_rig[3:, :3], by_rig[3:, 3:] = r_r2, r_t2, t_r2, t_t2
    by_pose[:3, :3], by_pose[:3, 3:], by_pose[3:, :3], by_pose[3:, 3:] = r_r1, r_t1, t_r1, t_t1
    return r.ravel(), t.ravel(), by_rig, by_pose


@dataclass
class Linear:
    """Residuals and normal equations at a point: of the rig, of each pose, and mixed."""

    vector: FloatArray
    poses: FloatArray
    residuals: list[FloatArray]
    weights: Sequence[FloatArray]
    normal: FloatArray
    gradient: FloatArray
    pose_normals: FloatArray
    pose_gradients: FloatArray
    mixed: FloatArray
    penalty: float

    @property
    def squares(self) -> float:
        return self.penalty + _weighted(self.residuals, self.weights)

    def reduced(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return normal matrix and gradient of the rig with the poses eliminated, and the poses' normal matrices."""
        poses = self.pose_normals + damping * self.pose_normals * np.eye(POSE)
        eliminated = np.linalg.solve(poses, np.transpose(self.mixed, (0, 2, 1)))
        normal = self.normal + damping * np.diag(np.diag(self.normal))
        normal = normal - np.tensordot(self.mixed, eliminated, axes=([0, 2], [0, 1]))
        gradient = self.gradient - np.tensordot(eliminated, self.pose_gradients, axes=([0, 1], [0, 1]))
        return normal, gradient, poses

    def step(self, damping: float) -> tuple[FloatArray, FloatArray] | None:
        """Return the next step of rig and poses; None if the equations have no solution."""
        try:
            normal, gradient, poses = self.reduced(damping)
            if (np.diag(normal) <= 0.0).any():  # no solution, by rounding far from any minimum
                return None
            scale = 1.0 / np.sqrt(np.diag(normal))
            rig = scale * np.linalg.solve(normal * np.outer(scale, scale), scale * gradient)
            remaining = self.pose_gradients - np.einsum("vij,i->vj", self.mixed, rig)
            return rig, np.linalg.solve(poses, remaining[..., None])[..., 0]
        except np.linalg.LinAlgError:
            return None


def _weighted(residuals: Sequence[FloatArray], weights: Sequence[FloatArray]) -> float:
    """Return the weighted sum of squared residuals [px²]."""
    return float(sum(np.sum(w[:, None] * each**2) for each, w in zip(residuals, weights, strict=True)))


def _linearised(
    views: Sequence[View],
    corners_m: FloatArray,
    model: Model,
    vector: FloatArray,
    poses: FloatArray,
    weights: Sequence[FloatArray],
    prior: FloatArray | None = None,
) -> Linear:
    p, m = len(vector), len(views)
    known = np.zeros(p) if prior is None else prior
    linear = Linear(
        vector,
        poses,
        [],
        weights,
        np.diag(known),
        -known * vector,
        np.zeros((m, 6, 6)),
        np.zeros((m, 6)),
        np.zeros((m, p, 6)),
        float(known @ vector**2),
    )
    lenses, right_eye = split_lenses(model, vector)
    for k, (view, pose) in enumerate(zip(views, poses, strict=True)):
        residual, J = residuals_and_jacobian(view, corners_m, lenses, right_eye, pose)
        rows = np.column_stack([J, residual.ravel()])
        products = rows.T @ (np.repeat(weights[k], 2)[:, None] * rows)
        linear.normal += products[:p, :p]
        linear.gradient += products[:p, -1]
        linear.mixed[k] = products[:p, p:-1]
        linear.pose_normals[k] = products[p:-1, p:-1]
        linear.pose_gradients[k] = products[p:-1, -1]
        linear.residuals.append(residual)
    return linear
