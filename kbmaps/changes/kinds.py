"""What may change while an arm is running, and how far that moves the marker."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.chains.parameters import ChainParameters

TOOL, CAMERA, JOINT, OTHER = "tool", "camera", "joint", "other"
# What explains a change as well as one part does although everything may have changed, is seldom what happened.
_OTHER_SHARE = 0.001


@dataclass(frozen=True, eq=False)
class ChangeKind:
    """One part of the chain that may be another one from some pair on.

    Attributes:
        name: `tool`, `camera`, `joint` or `other`.
        joint: which one (from 0) where one joint's zero changed; else None.
        columns: the parameters (k,) that change, as in `ChainParameters`.
        units: by how much each has to change to move the marker by about a metre (k,) [rad/m, m/m].
        share: how probable this kind is before anything is known of a change.
    """

    name: str
    joint: int | None
    columns: IntArray
    units: FloatArray
    share: float


def change_kinds(parameters: ChainParameters, distance_m: float) -> tuple[ChangeKind, ...]:
    """The tool, the camera, and each joint's zero, as probable as each other but for the joints, which share theirs.

    Args:
        parameters: of the chain.
        distance_m: from the camera to the marker, usually [m].
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
    """Everything at once: what a change is that no single part explains."""
    units = np.where(parameters.turning, 1.0 / parameters.reach, 1.0) / math.sqrt(parameters.size / 3.0)
    return ChangeKind(OTHER, None, np.arange(parameters.size), units, _OTHER_SHARE)
