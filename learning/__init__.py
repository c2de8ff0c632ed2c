"""Online learner of pairs, without I/O and without a clock."""

from __future__ import annotations

from bodyschema.learning.learnt_model import LearntModel
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.snapshot import NoFrameError, Prediction, Snapshot
from bodyschema.learning.solvers.solver import DirectSolver, Solved, Solver, Task
from bodyschema.learning.state import LearningState, StateError

__all__ = [
    "DirectSolver",
    "LearningState",
    "LearntModel",
    "NoFrameError",
    "NominalModel",
    "OnlineLearner",
    "Prediction",
    "Snapshot",
    "Solved",
    "Solver",
    "StateError",
    "Task",
]
