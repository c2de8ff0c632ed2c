"""Kinematic Bézier Maps: forward kinematics that is linear in its parameters, and learners for it.

Numpy and scipy only; no I/O, no clock, no logging. Angles [rad], lengths [m], float64. The innermost loops are compiled
where a C compiler was there on installation: `kernels_in_use()` tells; BODYSCHEMA_PURE=1 goes without them.
"""

from kbmaps.align import Alignment, align
from kbmaps.autocorrelation import shared_by
from kbmaps.basis import JointBasis, learning_bases
from kbmaps.block_choice import blockwise_precision, follow_a_path
from kbmaps.chain import RigidChain
from kbmaps.chain_belief import ChainBelief
from kbmaps.chain_parameters import ChainParameters, ChainTolerances
from kbmaps.chain_report import ChainReport, Interval
from kbmaps.chain_search import find_chain
from kbmaps.contest import Contest
from kbmaps.core_prior import CoreFamily, CorePrior
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
from kbmaps.kernel_learner import KernelLearner
from kbmaps.kernels import in_use as kernels_in_use
from kbmaps.lack_of_fit import systematic_error
from kbmaps.ladder import Ladder, Rung
from kbmaps.memory import Memory
from kbmaps.model import Estimate, Model
from kbmaps.nlms import NLMS
from kbmaps.posterior import ChainPosterior, Posterior
from kbmaps.reach import PoseModel, PositionModel
from kbmaps.residual_learner import ResidualLearner
from kbmaps.residual_model import ResidualModel
from kbmaps.resolved_rates import resolved_rates
from kbmaps.rigid_learner import RigidLearner
from kbmaps.rigid_recursive import RecursiveRigidLearner
from kbmaps.rotations import nearest_rotation
from kbmaps.step_size import StepSize
from kbmaps.structured_learner import StructuredLearner
from kbmaps.support import SUPPORT_LIMIT, SupportSet
from kbmaps.tensor_learner import TensorLearner
from kbmaps.tensor_posterior import TensorPosterior
from kbmaps.tensor_settings import TensorSettings
from kbmaps.tensor_train import TensorTrain
from kbmaps.tool import with_refitted_marker
from kbmaps.tool_layer import ToolLayer

__all__ = [
    "NLMS",
    "SUPPORT_LIMIT",
    "Alignment",
    "BasisError",
    "ChainBelief",
    "ChainError",
    "ChainParameters",
    "ChainPosterior",
    "ChainReport",
    "ChainTolerances",
    "Contest",
    "CoreFamily",
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
    "KernelLearner",
    "Ladder",
    "Memory",
    "Model",
    "ModelFormatError",
    "NonFiniteError",
    "PoseModel",
    "PositionModel",
    "Posterior",
    "RecursiveRigidLearner",
    "ResidualLearner",
    "ResidualModel",
    "RigidChain",
    "RigidLearner",
    "RotationError",
    "Rung",
    "SettingError",
    "ShapeError",
    "SingularAlphaError",
    "StepSize",
    "StructuredLearner",
    "SupportSet",
    "TensorLearner",
    "TensorPosterior",
    "TensorSettings",
    "TensorTrain",
    "ToolLayer",
    "align",
    "blockwise_precision",
    "candidate_motions",
    "expected_gain",
    "find_chain",
    "follow_a_path",
    "kernels_in_use",
    "learning_bases",
    "nearest_rotation",
    "next_pose",
    "next_poses",
    "next_stretch",
    "prediction_errors",
    "resolved_rates",
    "shared_by",
    "systematic_error",
    "with_refitted_marker",
]
