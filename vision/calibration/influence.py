"""Influence of each corner on a joint fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.rig.stereo_rig import CalibrationError

from .bundle import UNDETERMINED, Bundle, residuals_and_jacobian, split_lenses
from .view import View


@dataclass(frozen=True)
class Influence:
    """Influence of one view's corners, the left eye's before the right one's."""

    residual: FloatArray  # measured minus predicted, shape (corners, 2) [px]
    by_pose: FloatArray  # Jacobian of the prediction by the board's pose, shape (2 corners, 6)
    remaining_share: FloatArray  # share of its variance that remains in each corner's residual, shape (corners,)


def influences(views: Sequence[View], corners_m: FloatArray, bundle: Bundle) -> Iterator[Influence]:
    """Yield the influence of each fitted view."""
    rig = inverse_of(bundle.normal)
    lenses, right_eye = split_lenses(bundle.model, bundle.vector)
    for view, pose, weights in zip(views, bundle.poses, bundle.weights, strict=True):
        residual, slopes = residuals_and_jacobian(view, corners_m, lenses, right_eye, pose)
        J, K = np.split(slopes, [len(rig)], axis=1)
        w = np.repeat(weights, 2)[:, None]
        of_pose = np.linalg.inv(K.T @ (w * K))
        J = J - K @ of_pose @ (K.T @ (w * J))
        # The diagonal of the hat matrix (Huber & Ronchetti 2009, section 7.1).
        leverage = w[:, 0] * (np.sum(J @ rig * J, axis=1) + np.sum(K @ of_pose * K, axis=1))
        remaining_share = 1.0 - leverage.reshape(-1, 2).mean(axis=1)
        yield Influence(residual, K, remaining_share)


def inverse_of(normal: FloatArray) -> FloatArray:
    """Return the inverse of a normal matrix whose parameters have different units.

    Raises:
        CalibrationError: it is not positive definite.
    """
    if not (np.diag(normal) > 0.0).all():
        raise CalibrationError(UNDETERMINED)
    scale = 1.0 / np.sqrt(np.diag(normal))
    return np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
