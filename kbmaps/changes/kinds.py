"""Kinds of change of a running arm, and the marker motion that each causes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.chains.parameters import ChainParameters

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
        parameters: of the chain.
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
