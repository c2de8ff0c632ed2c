"""Influence of each corner on a joint fit, and the rig's covariance from it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .bundle import Bundle, lenses_and_rest, seen_with_slopes
from .view import View


@dataclass(frozen=True)
class Influence:
    """Influence of one view's corners, the left eye's before the right one's.

    Attributes:
        residual: measured minus predicted, shape (corners, 2) [px].
        scores: pull of each coordinate on the rig, with its pose adapted, shape (2 corners, p).
        normal: part of the view in the rig's normal equations, with its pose adapted, shape (p, p).
        by_pose: Jacobian of the prediction by the board's pose, shape (2 corners, 6).
        free: share of its variance that the fit leaves each corner, shape (corners,).
    """

    residual: FloatArray
    scores: FloatArray
    normal: FloatArray
    by_pose: FloatArray
    free: FloatArray


def influences(views: Sequence[View], corners_m: FloatArray, bundle: Bundle) -> Iterator[Influence]:
    """Yield the influence of each fitted view."""
    rig = _inverse(bundle.normal)
    lenses, right_eye = lenses_and_rest(bundle.model, bundle.vector)
    for view, pose, weights in zip(views, bundle.poses, bundle.weights, strict=True):
        residual, slopes = seen_with_slopes(view, corners_m, lenses, right_eye, pose)
        J, K = np.split(slopes, [len(rig)], axis=1)
        w = np.repeat(weights, 2)[:, None]
        of_pose = np.linalg.inv(K.T @ (w * K))
        J = J - K @ of_pose @ (K.T @ (w * J))
        # The diagonal of the hat matrix (Huber & Ronchetti 2009, section 7.1).
        taken = w[:, 0] * (np.sum(J @ rig * J, axis=1) + np.sum(K @ of_pose * K, axis=1))
        free = 1.0 - taken.reshape(-1, 2).mean(axis=1)
        yield Influence(residual, w * J, J.T @ (w * J), K, free)


def covariance(views: Sequence[View], corners_m: FloatArray, bundle: Bundle) -> FloatArray:
    """Return the covariance of the rig's parameters, shape (p, p), without assuming independent corners of one view.

    A board that is not flat and a lens that no model describes move the corners of a view together. So each view as a
    whole stands for its own variance: the delete-one jackknife over the views (Efron 1982), linearised.
    """
    count = len(views)
    middle = np.zeros_like(bundle.normal)
    for each in influences(views, corners_m, bundle):
        pull = each.scores.T @ each.residual.ravel()
        moved = np.linalg.solve(bundle.normal - each.normal, pull)
        middle += np.outer(moved, moved)
    inverse = _inverse(bundle.normal)
    return middle * (count - 1) / count + inverse @ np.diag(bundle.prior) @ inverse * bundle.sigma_px**2


def _inverse(normal: FloatArray) -> FloatArray:
    scale = 1.0 / np.sqrt(np.diag(normal))
    return np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
