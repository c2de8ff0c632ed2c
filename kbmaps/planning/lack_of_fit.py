"""Systematic error of a model, separated from noise by the correlation of neighbouring residuals."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree  # pyright: ignore[reportMissingTypeStubs]

from kbmaps.arrays import FloatArray, IntArray, rows
from kbmaps.errors import ShapeError
from kbmaps.planning.posterior import Posterior

# Minimum number of neighbour couples, and of standard errors that their shared part must exceed.
_LEAST_NEIGHBOURS, _SURE = 10, 2.0


def systematic_error(posterior: Posterior, q: ArrayLike, residuals: ArrayLike) -> float:
    """Return the 1-sigma [m] of the part of a coordinate's residual that neighbouring poses share; 0 if due to chance.

    Noise is independent from pair to pair, while a bending joint or a distorting lens errs alike at poses near each
    other. The mean product of residuals of neighbours is therefore the systematic part, once the fit's own part has
    been removed: it makes the residuals of neighbours i and j share −R_i R_jᵀ. The result is a lower bound, since
    neighbours are not the same pose: the sparser the poses, the more of it counts as noise.

    Args:
        posterior: of the model that has learnt the pairs.
        q: poses (n, d) of the pairs, outliers left out.
        residuals: measured minus predicted positions there (n, 3) [m].

    Raises:
        ShapeError, NonFiniteError
    """
    poses, missed = rows("q", q, posterior.joints), rows("residuals", residuals, 3)
    if len(poses) != len(missed):
        raise ShapeError("residuals", f"({len(poses)}, 3) to go with q", missed.shape)
    if len(poses) < 2:
        return 0.0
    one, other = _neighbours(poses)
    roots = posterior.roots(poses)
    shared = np.einsum("ni,ni->n", missed[one], missed[other])
    shared = shared + np.einsum("nip,nip->n", roots[one], roots[other])
    doubt = float(shared.std()) / math.sqrt(len(shared))
    mean = float(shared.mean())
    if len(shared) < _LEAST_NEIGHBOURS or mean <= _SURE * doubt:
        return 0.0
    return math.sqrt(mean / 3.0)


def _neighbours(poses: FloatArray) -> tuple[IntArray, IntArray]:
    """Return each pose with its nearest one, each such couple once, distances in standard deviations of the joints."""
    std = poses.std(axis=0)
    scaled = poses / np.where(std > 0.0, std, 1.0)
    nearest = cast(IntArray, KDTree(scaled).query(scaled, 2)[1])  # pyright: ignore[reportUnknownMemberType]
    # Where poses are equal, a pose may not be found first among its own neighbours.
    own = np.arange(len(poses))
    found = np.where(nearest[:, 0] == own, nearest[:, 1], nearest[:, 0])
    couples = np.unique(np.sort(np.stack([own, found], axis=1), axis=1), axis=0)
    return couples[:, 0], couples[:, 1]
