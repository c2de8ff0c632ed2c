"""Kinds of change of a running arm, and the marker motion that each causes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.chains.parameters import ChainParameters

# Sizes of a change over the noise of one measurement, equally probable: from a fraction of it to far beyond it.
SIZES = (0.5, 2.5, 12.0, 60.0)


def log_ratios(information: FloatArray, score: FloatArray, sizes: FloatArray) -> FloatArray:
    """Return the log likelihood ratio of a change θ ~ N(0, s² 1) to none, averaged over the sizes s, (m,).

    With the information G and the score u = G θ̂ that a linear model has of θ, and in G's eigenvectors:

        log Λ_s = ½ Σ_j u_j² s² / (1 + s² g_j) − ½ Σ_j log(1 + s² g_j)

    Without a change its expectation is 1, whatever the prior (Lai 1998, "Information bounds and quick detection of
    parameter changes in stochastic systems").

    Args:
        information: G (m, k, k).
        score: u (m, k).
        sizes: s (s,), in θ's units.
    """
    if score.shape[1] == 1:
        values, along = information[:, :, 0], score
    else:
        values, vectors = np.linalg.eigh(information)
        along = np.matvec(vectors.transpose(0, 2, 1), score)
    squares = np.square(sizes)[:, None]
    widened = 1.0 + squares * np.maximum(values, 0.0)[:, None]
    ratios = 0.5 * (squares * np.square(along)[:, None] / widened - np.log(widened)).sum(axis=2)
    return np.logaddexp.reduce(ratios, axis=1) - np.log(len(sizes))


TOOL, CAMERA, JOINT, OTHER = "tool", "camera", "joint", "other"
# A change of everything is seldom what happened if a change of one part explains the pairs as well.
_OTHER_SHARE = 0.001


@dataclass(frozen=True, eq=False)
class ChangeKind:
    """Part of the chain that may change from some pair on.

    Attributes:
        name: `tool`, `camera`, `joint` or `other`.
        joint: index of the joint (from 0) whose offset changed; else None.
        columns: the parameters (k,) that change, as in `ChainParameters`.
        units: change of each that moves the marker by about a metre (k,) [rad/m, m/m].
        share: prior probability of this kind.
    """

    name: str
    joint: int | None
    columns: IntArray
    units: FloatArray
    share: float


def change_kinds(parameters: ChainParameters, distance_m: float) -> tuple[ChangeKind, ...]:
    """Return the kinds tool, camera, and each joint's offset, equally probable; the joints share one third.

    Args:
        distance_m: usual distance from the camera to the marker [m].
    """
    camera = np.r_[parameters.base_turn, parameters.base_shift]
    turned = np.r_[np.full(3, 1.0 / max(distance_m, 1e-3)), np.ones(3)] / math.sqrt(2.0)
    kinds = [
        ChangeKind(TOOL, None, np.r_[parameters.tool], np.ones(3), 1.0 / 3.0),
        ChangeKind(CAMERA, None, camera, turned, 1.0 / 3.0),
    ]
    zeros = np.arange(parameters.size)[parameters.zeros]
    for joint, column in enumerate(zeros):
        unit = 1.0 if parameters.reference.prismatic[joint] else 1.0 / parameters.reach
        kinds.append(ChangeKind(JOINT, joint, np.array([column]), np.array([unit]), 1.0 / (3.0 * len(zeros))))
    return tuple(kinds)


def any_change(parameters: ChainParameters) -> ChangeKind:
    """Return the change of everything at once, for a change that no single part explains."""
    units = np.where(parameters.turning, 1.0 / parameters.reach, 1.0) / math.sqrt(parameters.size / 3.0)
    return ChangeKind(OTHER, None, np.arange(parameters.size), units, _OTHER_SHARE)
