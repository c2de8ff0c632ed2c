"""Detect lenses that refocused between the views: each view fits another focal length."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.special import chdtri

from bodyschema.interfaces.records import FloatArray

from .bundle import Bundle, residuals_and_jacobian, split_lenses
from .settings import FitSettings as _Settings
from .view import View


def focal_spread(views: Sequence[View], corners_m: FloatArray, bundle: Bundle) -> float | None:
    """Return the relative 1-sigma of the focal lengths over the views; None without evidence that they differ.

    Other errors leave residuals that a free focal length absorbs in part. So it competes with freedoms that absorb them
    too: the ratio of fx and fy, a board that is bent or not rectangular, and one that moved between the two images.
    The shape that the board has in all views alike is removed first.
    """
    lenses, right_eye = split_lenses(bundle.model, bundle.vector)
    seen, eyes = list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]](), list[FloatArray]()
    for view, pose, weights in zip(views, bundle.poses, bundle.weights, strict=True):
        residual, slopes = residuals_and_jacobian(view, corners_m, lenses, right_eye, pose)
        root, by_pose = np.sqrt(np.repeat(weights, 2))[:, None], slopes[:, -6:]
        focal, aspect = _by_lenses(slopes, [lens.focal_px for lens in lenses])
        others = [aspect]
        if len(lenses) > 1:
            is_right = np.arange(len(slopes)) >= (0 if view.left is None else 2 * len(view.left))
            others.append(is_right[:, None] * by_pose)
        in_view = focal.any(axis=0)
        eyes.append(np.eye(len(lenses))[in_view])
        # The board's pose is free.
        error, focal, board, rest = (
            _orthogonal(root * by_pose, root * each)
            for each in (
                residual.reshape(-1, 1),
                focal[:, in_view],
                _by_board(view, corners_m, by_pose, pose),
                np.column_stack(others),
            )
        )
        seen.append((error, focal, board, rest))
    shapes = np.concatenate([_orthogonal(focal, np.column_stack([board, error])) for error, focal, board, _ in seen])
    shape = np.linalg.lstsq(shapes[:, :-1], shapes[:, -1:])[0]
    by_focal, by_others, pulls = [], [], list[tuple[FloatArray, FloatArray]]()
    squares, freedom = 0.0, 0
    for (error, focal, board, rest), eye in zip(seen, eyes, strict=True):
        error = error - board @ shape
        normal, pull = np.sum(focal**2, axis=0), (focal.T @ error)[:, 0]
        pulls.append((eye.T @ focal.T @ focal @ eye, eye.T @ pull))
        by_focal.extend(pull**2 / normal)
        error, rest = _orthogonal(focal, error), _orthogonal(focal, np.column_stack([rest, board]))
        # A freedom that this view lacks explains nothing.
        by_others.append((rest.T @ error)[:, 0] ** 2 / np.maximum(np.sum(rest**2, axis=0), np.finfo(np.float64).tiny))
        squares += float(np.sum(error**2))
        freedom += len(error) - 6 - len(normal)
    variance = squares / max(freedom, 1)
    explained = np.mean(by_focal) / max(variance, np.mean(by_others, axis=0).max())
    if explained < max(_Settings.clearly, float(chdtri(len(by_focal), _Settings.false_alarms)) / len(by_focal)):
        return None
    return _spread(pulls, variance)


def _spread(pulls: Sequence[tuple[FloatArray, FloatArray]], variance: float) -> float:
    """Return the relative 1-sigma of the eyes' focal lengths, of which a part may be common to both.

    A board that moves along the axis hides most of a change that both eyes share, so the covariance of the eyes' focal
    lengths over the views is the most probable one (expectation maximisation).

    Args:
        pulls: the information (eyes, eyes) of each view on the focal lengths, and its gradient (eyes,).
        variance: variance of one residual.
    """
    information = np.stack([each for each, _ in pulls]) / variance
    pull = np.stack([each for _, each in pulls])[:, :, None] / variance
    one = np.eye(pull.shape[1])
    among = one
    for _ in range(_Settings.rounds):
        left = among @ np.linalg.inv(one + information @ among)
        factors = left @ pull
        among = np.mean(left + factors @ factors.transpose(0, 2, 1), axis=0)
    return float(np.sqrt(np.trace(among) / len(one)))


def refocused(spread: float) -> str:
    """Return the message for focal lengths with this relative 1-sigma."""
    return (
        f"a lens refocused between the views: its focal length wanders by {spread:.1%} (1-sigma). Switch autofocus "
        "off, set focus in [vision.cameras.…], and take the views again"
    )


def _by_lenses(slopes: FloatArray, focal_px: Sequence[tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (2 corners, eyes) by each eye's relative focal length, and by fx against fy."""
    # The poses of the right eye and of the board come after the lenses.
    each = (slopes.shape[1] - 6 * len(focal_px)) // len(focal_px)
    fx, fy = (
        np.column_stack([slopes[:, number * each + axis] * f[axis] for number, f in enumerate(focal_px)])
        for axis in range(2)
    )
    return fx + fy, fx - fy


def _by_board(view: View, corners_m: FloatArray, by_pose: FloatArray, pose: FloatArray) -> FloatArray:
    """Return the derivatives (2 corners, 5) by a bend of the board along each axis, a twist, and by two shears."""
    numbers = np.concatenate([corners.numbers for corners in (view.left, view.right) if corners is not None])
    R = np.asarray(cv2.Rodrigues(pose[:3])[0], dtype=np.float64)
    along = (by_pose[:, 3:] @ R).reshape(-1, 2, 3)
    centred = corners_m[:, :2] - corners_m[:, :2].mean(axis=0)
    x, y = (centred / np.abs(centred).max())[numbers].T
    shapes = np.column_stack([x * x, y * y, x * y, x * y, x * y])
    return (shapes[:, None, :] * along[:, :, [2, 2, 2, 0, 1]]).reshape(len(by_pose), -1)


def _orthogonal(columns: FloatArray, values: FloatArray) -> FloatArray:
    """Return `values` orthogonal to `columns`, both with rows first."""
    basis, _ = np.linalg.qr(columns)
    return values - basis @ (basis.T @ values)
