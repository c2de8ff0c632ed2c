"""Measure prediction errors on held-out pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from kbmaps import KBMapsError, RigidChain, align

BLOCKS = 10


class EvaluationError(BodyschemaError):
    """A recording is too short to train on one part of it and test on the other."""


@dataclass(frozen=True, slots=True)
class Split:
    """Selection of held-out rows."""

    held_out: NDArray[np.bool_]  # mask, shape (n,); the other rows are for training
    blocks: int  # number of held-out blocks, of the `BLOCKS` contiguous ones


def split_blocks(rows: int, share: float) -> Split:
    """Select evenly spread contiguous blocks of rows to hold out, since neighbouring pairs are not independent.

    The rows are split into `BLOCKS` blocks of equal length (to one row). The nearest whole number to `share` of them is
    held out, at least one; with 3 of 10 these are the second, the sixth and the ninth.

    Raises:
        EvaluationError: `share` leaves nothing for training or for testing, or there are fewer rows than blocks.
    """
    if not 0 < share < 1:
        raise EvaluationError(f"the held-out share {share:g} is not between 0 and 1; 0.3 is usual")
    if rows < BLOCKS:
        raise EvaluationError(f"{rows} rows are too few to hold blocks of them out; record at least {BLOCKS}")
    chosen = min(max(round(share * BLOCKS), 1), BLOCKS - 1)
    picked = ((np.arange(chosen) + 0.5) * BLOCKS / chosen).astype(int)
    block_of_row = np.arange(rows) * BLOCKS // rows
    return Split(np.isin(block_of_row, picked), chosen)


@dataclass(frozen=True, slots=True)
class ErrorFigures:
    """Distances between prediction and measurement on held-out pairs [m]."""

    pairs: int
    mean_m: float
    rms_m: float
    median_m: float
    p95_m: float
    max_m: float

    @classmethod
    def of(cls, predicted: FloatArray, measured: FloatArray) -> ErrorFigures:
        """Return the figures for predicted and measured positions, each shape (n, 3) [m]."""
        distances = np.linalg.norm(predicted - measured, axis=1)
        return cls(
            pairs=len(distances),
            mean_m=float(distances.mean()),
            rms_m=float(np.sqrt(np.mean(distances**2))),
            median_m=float(np.median(distances)),
            p95_m=float(np.quantile(distances, 0.95)),
            max_m=float(distances.max()),
        )


def aligned_chain(robot: RobotDescription, learnt: Recording) -> RigidChain:
    """Return the nominal chain with the unknowns of robot.toml fitted to `learnt`: the fair baseline.

    Raises:
        EvaluationError: the pairs do not determine it.
    """
    try:
        fit = align(
            robot.chain, learnt.q, learnt.x, pose_known=robot.camera.pose_known, marker_known=robot.robot.marker_known
        )
    except KBMapsError as error:
        raise EvaluationError(f"the nominal model cannot be aligned to the recording: {error}") from error
    return fit.chain


def coverage(
    predicted: FloatArray, measured: FloatArray, sigma: FloatArray, noise_sigma: FloatArray | float = 0.0
) -> float:
    """Return the share of coordinates whose error is within 1-sigma; 0.68 if sigma is right and errors are Gaussian.

    Args:
        predicted, measured: positions, shape (n, 3) [m].
        sigma: predicted 1-sigma, shape (n, 3) [m].
        noise_sigma: 1-sigma of the measurements [m], which `sigma` does not include.
    """
    return float(np.mean(np.abs(predicted - measured) <= np.hypot(sigma, noise_sigma)))
