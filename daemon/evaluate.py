"""How good predictions are on pairs that were not learnt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.recording import Recording
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.robot import RobotDescription
from kbmaps import KBMapsError, RigidChain, align

BLOCKS = 10


class EvaluationError(BodyschemaError):
    """There is too little in a recording to learn from one part of it and judge by the other."""


@dataclass(frozen=True, slots=True)
class Split:
    """Which rows are held out.

    Attributes:
        held_out: shape (n,); the others are for learning.
        blocks: how many of the `BLOCKS` contiguous blocks they are.
    """

    held_out: NDArray[np.bool_]
    blocks: int


def split_blocks(rows: int, share: float) -> Split:
    """Contiguous blocks of rows to hold out, evenly spread: neighbouring pairs are not independent.

    The rows are cut into `BLOCKS` blocks of equal length (to one row), of which the nearest whole number to
    `share` is held out, at least one; with 3 of 10 these are the second, the sixth and the ninth.

    Raises:
        EvaluationError: `share` leaves nothing to learn from or to judge by, or there are fewer rows than blocks.
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
        """Figures for predicted and measured positions, each shape (n, 3) [m]."""
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
    """The nominal chain with what robot.toml calls not known fitted to `learnt`: the honest "before".

    Raises:
        EvaluationError: the pairs do not determine it.
    """
    try:
        fit = align(
            robot.chain,
            learnt.q,
            learnt.x,
            pose_known=robot.camera.pose_known,
            marker_known=robot.robot.marker_known,
        )
    except KBMapsError as error:
        raise EvaluationError(f"the nominal model cannot be aligned to the recording: {error}") from error
    return fit.chain


def coverage(
    predicted: FloatArray, measured: FloatArray, sigma: FloatArray, noise_sigma: FloatArray | float = 0.0
) -> float:
    """Share of coordinates whose error lies within 1-sigma; 0.68 when the claim is right and errors are Gaussian.

    Args:
        predicted, measured: positions, shape (n, 3) [m].
        sigma: 1-sigma claimed for the predictions, shape (n, 3) [m].
        noise_sigma: 1-sigma of the measurements [m], which the claim does not include.
    """
    return float(np.mean(np.abs(predicted - measured) <= np.hypot(sigma, noise_sigma)))
