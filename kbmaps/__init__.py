"""Kinematic Bézier Maps: forward kinematics that is linear in its parameters, and learners for it.

Numpy and scipy only; no I/O, no clock, no logging. Angles [rad], lengths [m], float64.
"""

from kbmaps.align import Alignment, align
from kbmaps.basis import JointBasis, learning_bases
from kbmaps.block_choice import blockwise_precision, follow_a_path
from kbmaps.chain import RigidChain
from kbmaps.errors import (
    BasisError,
    ChainError,
    DegenerateDataError,
    KBMapsError,
    ModelFormatError,
    NonFiniteError,
    RotationError,
    SettingError,
    ShapeError,
    SingularAlphaError,
)
from kbmaps.exact import ExactLearner, ExactSolution
from kbmaps.inverse import InverseKinematics, InverseSolution
from kbmaps.kbmap import KBMap, prediction_errors
from kbmaps.nlms import NLMS
from kbmaps.reach import PoseModel, PositionModel
from kbmaps.resolved_rates import resolved_rates
from kbmaps.rotations import nearest_rotation
from kbmaps.support import SUPPORT_LIMIT, SupportSet
from kbmaps.tool import with_refitted_marker

__all__ = [
    "NLMS",
    "SUPPORT_LIMIT",
    "Alignment",
    "BasisError",
    "ChainError",
    "DegenerateDataError",
    "ExactLearner",
    "ExactSolution",
    "InverseKinematics",
    "InverseSolution",
    "JointBasis",
    "KBMap",
    "KBMapsError",
    "ModelFormatError",
    "NonFiniteError",
    "PoseModel",
    "PositionModel",
    "RigidChain",
    "RotationError",
    "SettingError",
    "ShapeError",
    "SingularAlphaError",
    "SupportSet",
    "align",
    "blockwise_precision",
    "follow_a_path",
    "learning_bases",
    "nearest_rotation",
    "prediction_errors",
    "resolved_rates",
    "with_refitted_marker",
]
