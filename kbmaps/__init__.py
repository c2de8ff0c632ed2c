"""Kinematic Bézier Maps: forward kinematics that is linear in its parameters, and learners for it.

Numpy and scipy only; no I/O, no clock, no logging. Angles [rad], lengths [m], float64.
"""

from kbmaps.align import Alignment, align
from kbmaps.basis import JointBasis, learning_bases
from kbmaps.block_choice import blockwise_precision, follow_a_path
from kbmaps.chain import RigidChain
from kbmaps.chain_parameters import ChainParameters, ChainTolerances
from kbmaps.chain_report import ChainReport, Interval
from kbmaps.chain_search import find_chain
from kbmaps.core_prior import CorePrior
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
from kbmaps.expected_gain import ExpectedError, Forecast, candidate_motions, expected_gain
from kbmaps.experiment_design import ExperimentDesign, next_pose, next_poses, next_stretch
from kbmaps.inverse import InverseKinematics, InverseSolution
from kbmaps.kbmap import KBMap, prediction_errors
from kbmaps.lack_of_fit import systematic_error
from kbmaps.model import Estimate, Model
from kbmaps.nlms import NLMS
from kbmaps.posterior import ChainPosterior, Posterior
from kbmaps.reach import PoseModel, PositionModel
from kbmaps.resolved_rates import resolved_rates
from kbmaps.rigid_learner import RigidLearner
from kbmaps.rigid_recursive import RecursiveRigidLearner
from kbmaps.rotations import nearest_rotation
from kbmaps.support import SUPPORT_LIMIT, SupportSet
from kbmaps.tensor_learner import TensorLearner
from kbmaps.tensor_settings import TensorSettings
from kbmaps.tensor_train import TensorTrain
from kbmaps.tool import with_refitted_marker

__all__ = [
    "NLMS",
    "SUPPORT_LIMIT",
    "Alignment",
    "BasisError",
    "ChainError",
    "ChainParameters",
    "ChainPosterior",
    "ChainReport",
    "ChainTolerances",
    "CorePrior",
    "DegenerateDataError",
    "Estimate",
    "ExactLearner",
    "ExactSolution",
    "ExpectedError",
    "ExperimentDesign",
    "Forecast",
    "Interval",
    "InverseKinematics",
    "InverseSolution",
    "JointBasis",
    "KBMap",
    "KBMapsError",
    "Model",
    "ModelFormatError",
    "NonFiniteError",
    "PoseModel",
    "PositionModel",
    "Posterior",
    "RecursiveRigidLearner",
    "RigidChain",
    "RigidLearner",
    "RotationError",
    "SettingError",
    "ShapeError",
    "SingularAlphaError",
    "SupportSet",
    "TensorLearner",
    "TensorSettings",
    "TensorTrain",
    "align",
    "blockwise_precision",
    "candidate_motions",
    "expected_gain",
    "find_chain",
    "follow_a_path",
    "learning_bases",
    "nearest_rotation",
    "next_pose",
    "next_poses",
    "next_stretch",
    "prediction_errors",
    "resolved_rates",
    "systematic_error",
    "with_refitted_marker",
]
