"""Detect from residuals if the tool was changed during a recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from kbmaps import ChainBelief, ChainParameters, RigidLearner


@dataclass(frozen=True)
class _Settings:
    """Settings of the test for another tool."""

    # Minimum number of pairs on either side of a change, and the share of all squared residuals that it must explain.
    fewest: int = 6
    explained: float = 0.5
    # Residuals beyond this multiple of the median get less weight, so that single outliers are no change.
    far: float = 5.0
    # Excludes splits that the data cannot determine, e.g. where all poses are alike.
    ridge: float = 1e-9


_SETTINGS = _Settings()


@dataclass(frozen=True, slots=True)
class ToolJump:
    """A change of the tool.

    Attributes:
        row: the first row with the other tool, counted from 1.
        distance_m: distance between the marker positions of the two tools.
    """

    row: int
    distance_m: float


def tool_jump(learner: RigidLearner, recording: Recording) -> ToolJump | None:
    """Return the first row at which the marker has another place on the hand; None if there seems to be one tool.

    This is a change point test (Page 1955): two marker positions instead of one, with all other chain parameters fitted
    along, to first order. The chain was fitted to both tools and is therefore distorted, so distance and row are
    approximate.

    Args:
        learner: fitted to all pairs in the recording.
    """
    if len(recording) < 2 * _SETTINGS.fewest:
        return None
    explained, shifts = _splits(learner, recording)
    allowed = slice(_SETTINGS.fewest - 1, len(recording) - _SETTINGS.fewest)
    best = _SETTINGS.fewest - 1 + int(explained[allowed].argmax())
    if explained[best] < _SETTINGS.explained:
        return None
    return ToolJump(best + 2, float(np.linalg.norm(shifts[best])))


def _splits(learner: RigidLearner, recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Return the share of squared residuals (n - 1,) explained by a tool change after each row but the last.

    Also return the displacement of the marker by that change (n - 1, 3) [m].
    """
    parameters = ChainParameters(learner.nominal)
    x, jacobian = parameters.linearised(learner.change, recording.q)
    residuals, tools = recording.x - x, jacobian[:, :, parameters.tool]
    roots = _weights(residuals)[:, None]
    prior = ChainBelief.from_tolerances(parameters, learner.tolerances)
    noise = np.sqrt(np.square(roots * residuals).mean())
    free = (roots[:, :, None] * jacobian).reshape(-1, parameters.size) @ prior.root / noise
    basis = np.linalg.qr(np.concatenate([free, np.eye(parameters.size)]))[0][: len(free)]
    target = (roots * residuals).ravel()
    target = (target - basis @ (basis.T @ target)).reshape(residuals.shape)
    columns = roots[:, :, None] * tools
    # Sums over all rows after each split, of the part of the columns that the other parameters do not explain.
    in_basis = _after(np.einsum("nip,nij->npj", basis.reshape(*residuals.shape, -1), columns))
    square = _after(columns.swapaxes(1, 2) @ columns) - in_basis.swapaxes(1, 2) @ in_basis
    product = _after(np.einsum("nij,ni->nj", columns, target))
    shifts: FloatArray = np.linalg.solve(square + _SETTINGS.ridge * np.eye(3), product[..., None])[..., 0].astype(
        np.float64
    )
    return np.einsum("nj,nj->n", shifts, product) / np.square(target).sum(), shifts


def _weights(residuals: FloatArray) -> FloatArray:
    """Return square roots of the weights (n,) of residuals (n, 3)."""
    squares = np.square(residuals).sum(axis=1)
    far = _SETTINGS.far**2 * max(float(np.median(squares)), np.finfo(float).tiny)
    return np.sqrt(far / (far + squares))


def _after(values: FloatArray) -> FloatArray:
    """Return the sums of all values (n, ...) after each but the last: (n - 1, ...)."""
    return np.cumsum(values[::-1], axis=0)[::-1][1:]
