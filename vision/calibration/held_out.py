"""Held-out error and covariance of a calibration, from fits without some of the views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .bundle import POSE, Bundle, solve, view_residuals
from .influence import inverse_of
from .settings import FitSettings as _Settings
from .view import View
from .weights import refit_weighted


@dataclass(frozen=True)
class HeldOut:
    """Errors of each view when it was held out, except for its own pose."""

    squares: FloatArray  # sum of squared residuals of each view [px²]
    freedom: NDArray[np.int64]  # image coordinates of each view minus the parameters of its pose

    @property
    def rms_px(self) -> float:
        """RMS error per image coordinate [px]."""
        return float(np.sqrt(self.squares.sum() / self.freedom.sum()))

    @property
    def view_rms_px(self) -> FloatArray:
        """RMS error per image coordinate of each view [px]."""
        return np.sqrt(self.squares / self.freedom)

    def is_better_than(self, other: HeldOut) -> bool:
        """Return True if the mean log error is lower than that of `other` by more than twice its standard error."""
        gain = np.log(other.squares / self.squares)
        return float(gain.mean()) > 2.0 * float(gain.std(ddof=1)) / np.sqrt(len(gain))


def held_out(views: Sequence[View], corners_m: FloatArray, full_fit: Bundle) -> HeldOut:
    """Cross-validate by views: hold out a tenth of them in turn and predict them.

    Args:
        full_fit: the fit of all views, from which each part's fit starts. Its rejected corners do not count here.
    """
    groups = np.arange(len(views)) % min(_Settings.folds, len(views))
    squares = np.zeros(len(views))
    for group in range(groups.max() + 1):
        kept = np.flatnonzero(groups != group).tolist()
        weights = [full_fit.weights[k] for k in kept]
        part = solve(
            [views[k] for k in kept],
            corners_m,
            full_fit.model,
            full_fit.vector,
            full_fit.poses[kept],
            weights,
            full_fit.prior,
        )
        for k in np.flatnonzero(groups == group).tolist():
            own = full_fit.weights[k]
            left = view_residuals(views[k], corners_m, full_fit.model, part.vector, full_fit.poses[k], own)
            squares[k] = np.sum(left[own > 0.0] ** 2)
    freedom = np.array([each.size - POSE for each in full_fit.kept])
    return HeldOut(squares, freedom)


def covariance(views: Sequence[View], corners_m: FloatArray, full_fit: Bundle) -> FloatArray:
    """Return the covariance of the rig's parameters, shape (p, p), without assuming independent corners within a view.

    A board that is not flat or moves between the two images, and a lens that no model describes, move the corners of
    a view together. So the variance is estimated over whole views: the delete-one jackknife (Efron 1982). If views
    disagree, the weights of all depend on each, so they are recomputed without it.
    """
    count = len(views)
    moved = np.zeros((count, len(full_fit.vector)))
    for k in range(count):
        start = replace(
            full_fit,
            poses=np.delete(full_fit.poses, k, axis=0),
            weights=(*full_fit.weights[:k], *full_fit.weights[k + 1 :]),
        )
        moved[k] = refit_weighted([*views[:k], *views[k + 1 :]], corners_m, start).vector
    inverse = inverse_of(full_fit.normal)
    known = inverse @ np.diag(full_fit.prior) @ inverse * full_fit.sigma_px**2
    return np.cov(moved, rowvar=False, bias=True) * (count - 1) + known
