"""Whether a recording is a guided path, or single poses far apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyschema.daemon.align import joint_difference
from bodyschema.daemon.config import DaemonConfig
from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.recording import Recording
from bodyschema.interfaces.robot import RobotDescription

MOST = 0.5


@dataclass(frozen=True, slots=True)
class Steps:
    """The steps between neighbouring rows, by the sampler's rule.

    Attributes:
        count: how many there are.
        too_far: how many are larger than `max_step_deg`.
        median_deg: their median.
    """

    count: int
    too_far: int
    median_deg: float
    max_step_deg: float

    @classmethod
    def of(cls, recording: Recording, robot: RobotDescription, rules: DaemonConfig) -> Steps:
        """The steps of a recording of at least two rows."""
        prismatic = robot.chain.prismatic
        units = np.where(prismatic, 1 / rules.metres_per_degree, 180 / np.pi)
        steps_deg = np.linalg.norm(joint_difference(recording.q[1:], recording.q[:-1], prismatic) * units, axis=1)
        too_far = int(np.count_nonzero(steps_deg > rules.max_step_deg))
        return cls(len(steps_deg), too_far, float(np.median(steps_deg)), rules.max_step_deg)

    @property
    def is_path(self) -> bool:
        """Whether most rows follow from their predecessors."""
        return self.too_far <= MOST * self.count

    def __str__(self) -> str:
        return (
            f"{self.too_far} of {self.count} steps are larger than max_step_deg = {self.max_step_deg:g} "
            f"(median {self.median_deg:.1f}°)"
        )


def require_path(steps: Steps, recording: Recording) -> None:
    """RecordingError when the rows are single poses far apart."""
    if not steps.is_path:
        raise RecordingError(
            f"{steps}: these are single poses, not a guided path, and the sampler's step and speed rules do not "
            "apply to them",
            file=recording.file or "recording",
            remedy="Give --any-step to relax these rules and accept every row, each as a segment of its own",
        )
