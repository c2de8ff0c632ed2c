"""Online learner of pairs, without I/O and without a clock."""

from __future__ import annotations

from .learning import Learning
from .learnt import LearntModel
from .nominal import NominalModel
from .snapshot import NoFrameError, Prediction, Snapshot
from .solver import DirectSolver, Solved, Solver, Task
from .state import LearningState, StateError

__all__ = [
    "DirectSolver",
    "Learning",
    "LearningState",
    "LearntModel",
    "NoFrameError",
    "NominalModel",
    "Prediction",
    "Snapshot",
    "Solved",
    "Solver",
    "StateError",
    "Task",
]
