"""Kinematic Bézier Maps: forward kinematics that is linear in its parameters, and learners for it.

Needs only numpy and scipy: no I/O, no clock, no logging. Angles [rad], lengths [m], float64. The innermost loops are
compiled if a C compiler was present at installation: see `kernels_in_use()`. BODYSCHEMA_PURE=1 disables them.

Arrays of a wrong shape raise `ShapeError`, those that are not finite `NonFiniteError`, and
damaged bytes `ModelFormatError`; docstrings name other errors.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kbmaps.chains.align import Alignment, align
    from kbmaps.chains.belief import ChainBelief
    from kbmaps.chains.chain import RigidChain
    from kbmaps.chains.oriented import OrientedChain, fitted_orientation
    from kbmaps.chains.parameters import ChainParameters, ChainTolerances
    from kbmaps.chains.report import ChainReport, Interval
    from kbmaps.chains.rigid_learner import RigidLearner
    from kbmaps.chains.rigid_recursive import RecursiveRigidLearner
    from kbmaps.chains.search import find_chain
    from kbmaps.chains.tool_layer import ToolLayer, with_refitted_tool
    from kbmaps.changes.detector import ChangeDetector, ChangeScore
    from kbmaps.changes.kinds import ChangeKind, any_change, change_kinds
    from kbmaps.changes.naming import Explanation, explanations
    from kbmaps.changes.shared_noise import SharedNoise
    from kbmaps.changes.white_noise import WhiteNoise
    from kbmaps.contest import PrequentialComparison, Recent, shared_by
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
    from kbmaps.ladder import Ladder, Rung
    from kbmaps.maps.basis import JointBasis, learning_bases
    from kbmaps.maps.block_choice import blockwise_precision, follow_a_path
    from kbmaps.maps.exact import ExactLearner, ExactSolution
    from kbmaps.maps.kbmap import KBMap, prediction_errors
    from kbmaps.maps.kernels import kernels_in_use
    from kbmaps.maps.nlms import NLMS, StepSize
    from kbmaps.maps.support import SUPPORT_LIMIT, SupportSet
    from kbmaps.memory import Memory
    from kbmaps.model import Estimate, Model, PoseModel, PositionModel
    from kbmaps.planning.design import ExperimentDesign, next_pose, next_poses
    from kbmaps.planning.expected_gain import ExpectedError, Forecast, candidate_motions, expected_gain
    from kbmaps.planning.posterior import ChainPosterior, Posterior
    from kbmaps.residual.learner import ResidualLearner
    from kbmaps.residual.model import ResidualModel
    from kbmaps.robust import unexplained_variance
    from kbmaps.rotations import nearest_rotation, quaternions, rotation_matrices, rotation_vectors
    from kbmaps.trains.core_prior import CoreFamily, CorePrior
    from kbmaps.trains.learner import TensorLearner
    from kbmaps.trains.posterior import TensorPosterior
    from kbmaps.trains.train import TensorSettings, TensorTrain

__version__ = "0.1.0"

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
    "ChangeScore",
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
    "PrequentialComparison",
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
    "SupportSet",
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
    "prediction_errors",
    "quaternions",
    "resolved_rates",
    "rotation_matrices",
    "rotation_vectors",
    "shared_by",
    "unexplained_variance",
    "with_refitted_tool",
]

# Each public name is imported on first use: importing all of them takes 0.7 s of CPU.
_MODULES = {
    "chains.align": ["Alignment", "align"],
    "chains.belief": ["ChainBelief"],
    "chains.chain": ["RigidChain"],
    "chains.oriented": ["OrientedChain", "fitted_orientation"],
    "chains.parameters": ["ChainParameters", "ChainTolerances"],
    "chains.report": ["ChainReport", "Interval"],
    "chains.rigid_learner": ["RigidLearner"],
    "chains.rigid_recursive": ["RecursiveRigidLearner"],
    "chains.search": ["find_chain"],
    "chains.tool_layer": ["ToolLayer", "with_refitted_tool"],
    "changes.detector": ["ChangeDetector", "ChangeScore"],
    "changes.kinds": ["ChangeKind", "any_change", "change_kinds"],
    "changes.naming": ["Explanation", "explanations"],
    "changes.shared_noise": ["SharedNoise"],
    "changes.white_noise": ["WhiteNoise"],
    "contest": ["PrequentialComparison", "Recent", "shared_by"],
    "errors": [
        "BasisError",
        "ChainError",
        "DegenerateDataError",
        "KBMapsError",
        "ModelFormatError",
        "NetSizeError",
        "NonFiniteError",
        "NotNumbersError",
        "RotationError",
        "SettingError",
        "ShapeError",
        "SingularAlphaError",
    ],
    "inverse.kinematics": ["InverseKinematics", "InverseSolution"],
    "inverse.resolved_rates": ["resolved_rates"],
    "kernel.kernel_learner": ["KernelLearner"],
    "ladder": ["Ladder", "Rung"],
    "maps.basis": ["JointBasis", "learning_bases"],
    "maps.block_choice": ["blockwise_precision", "follow_a_path"],
    "maps.exact": ["ExactLearner", "ExactSolution"],
    "maps.kbmap": ["KBMap", "prediction_errors"],
    "maps.kernels": ["kernels_in_use"],
    "maps.nlms": ["NLMS", "StepSize"],
    "maps.support": ["SUPPORT_LIMIT", "SupportSet"],
    "memory": ["Memory"],
    "model": ["Estimate", "Model", "PoseModel", "PositionModel"],
    "planning.design": ["ExperimentDesign", "next_pose", "next_poses"],
    "planning.expected_gain": ["ExpectedError", "Forecast", "candidate_motions", "expected_gain"],
    "planning.posterior": ["ChainPosterior", "Posterior"],
    "residual.learner": ["ResidualLearner"],
    "residual.model": ["ResidualModel"],
    "robust": ["unexplained_variance"],
    "rotations": ["nearest_rotation", "quaternions", "rotation_matrices", "rotation_vectors"],
    "trains.core_prior": ["CoreFamily", "CorePrior"],
    "trains.learner": ["TensorLearner"],
    "trains.posterior": ["TensorPosterior"],
    "trains.train": ["TensorSettings", "TensorTrain"],
}
_HOMES = {name: f"kbmaps.{module}" for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'kbmaps' has no attribute {name!r}")
    found = getattr(import_module(_HOMES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
