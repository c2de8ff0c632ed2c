"""Kinematic Bézier Maps: forward kinematics that is linear in its parameters, and learners for it.

Numpy and scipy only; no I/O, no clock, no logging. Angles [rad], lengths [m], float64. The innermost loops are compiled
where a C compiler was there on installation: `kernels_in_use()` tells; BODYSCHEMA_PURE=1 goes without them.
"""

from kbmaps.autocorrelation import shared_by
from kbmaps.chains.align import Alignment, align
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.oriented import OrientedChain, fitted_orientation
from kbmaps.chains.parameters import ChainParameters, ChainTolerances
from kbmaps.chains.refitted_tool import with_refitted_tool
from kbmaps.chains.report import ChainReport, Interval
from kbmaps.chains.rigid_learner import RigidLearner
from kbmaps.chains.rigid_recursive import RecursiveRigidLearner
from kbmaps.chains.search import find_chain
from kbmaps.chains.tool_layer import ToolLayer
from kbmaps.changes.detector import ChangeDetector, Suspicion
from kbmaps.changes.kinds import ChangeKind, any_change, change_kinds
from kbmaps.changes.naming import Explanation, explanations
from kbmaps.changes.shared_noise import SharedNoise
from kbmaps.changes.white_noise import WhiteNoise
from kbmaps.contest import Contest, Recent
from kbmaps.errors import (
    BasisError,
    ChainError,
    DegenerateDataError,
    KBMapsError,
    ModelFormatError,
    NetSizeError,
    NonFiniteError,
    NotNumbersError,
    RotationError,
    SettingError,
    ShapeError,
    SingularAlphaError,
)
from kbmaps.inverse.kinematics import InverseKinematics, InverseSolution
from kbmaps.inverse.resolved_rates import resolved_rates
from kbmaps.kernel.kernel_learner import KernelLearner
from kbmaps.kernel.structured_learner import StructuredLearner
from kbmaps.ladder import Ladder, Rung
from kbmaps.maps.basis import JointBasis, learning_bases
from kbmaps.maps.block_choice import blockwise_precision, follow_a_path
from kbmaps.maps.exact import ExactLearner, ExactSolution
from kbmaps.maps.kbmap import KBMap, prediction_errors
from kbmaps.maps.kernels import in_use as kernels_in_use
from kbmaps.maps.nlms import NLMS
from kbmaps.maps.step_size import StepSize
from kbmaps.maps.support import SUPPORT_LIMIT, SupportSet
from kbmaps.memory import Memory
from kbmaps.model import Estimate, Model, PoseModel, PositionModel
from kbmaps.planning.design import ExperimentDesign, next_pose, next_poses, next_stretch
from kbmaps.planning.expected_gain import ExpectedError, Forecast, candidate_motions, expected_gain
from kbmaps.planning.lack_of_fit import systematic_error
from kbmaps.planning.posterior import ChainPosterior, Posterior
from kbmaps.residual.learner import ResidualLearner
from kbmaps.residual.model import ResidualModel
from kbmaps.rotations import nearest_rotation, quaternions, rotation_matrices, rotation_vectors
from kbmaps.trains.core_prior import CoreFamily, CorePrior
from kbmaps.trains.learner import TensorLearner
from kbmaps.trains.posterior import TensorPosterior
from kbmaps.trains.settings import TensorSettings
from kbmaps.trains.train import TensorTrain

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
    "ChangeDetector",
    "ChangeKind",
    "Contest",
    "CoreFamily",
    "CorePrior",
    "DegenerateDataError",
    "Estimate",
    "ExactLearner",
    "ExactSolution",
    "ExpectedError",
    "ExperimentDesign",
    "Explanation",
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
    "NetSizeError",
    "NonFiniteError",
    "NotNumbersError",
    "OrientedChain",
    "PoseModel",
    "PositionModel",
    "Posterior",
    "Recent",
    "RecursiveRigidLearner",
    "ResidualLearner",
    "ResidualModel",
    "RigidChain",
    "RigidLearner",
    "RotationError",
    "Rung",
    "SettingError",
    "ShapeError",
    "SharedNoise",
    "SingularAlphaError",
    "StepSize",
    "StructuredLearner",
    "SupportSet",
    "Suspicion",
    "TensorLearner",
    "TensorPosterior",
    "TensorSettings",
    "TensorTrain",
    "ToolLayer",
    "WhiteNoise",
    "align",
    "any_change",
    "blockwise_precision",
    "candidate_motions",
    "change_kinds",
    "expected_gain",
    "explanations",
    "find_chain",
    "fitted_orientation",
    "follow_a_path",
    "kernels_in_use",
    "learning_bases",
    "nearest_rotation",
    "next_pose",
    "next_poses",
    "next_stretch",
    "prediction_errors",
    "quaternions",
    "resolved_rates",
    "rotation_matrices",
    "rotation_vectors",
    "shared_by",
    "systematic_error",
    "with_refitted_tool",
]
