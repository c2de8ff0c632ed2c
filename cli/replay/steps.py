"""Distinction between a guided path and single poses far apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyschema.daemon.config import DaemonConfig
from bodyschema.daemon.sampler.align import joint_difference
from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

MOST = 0.5


@dataclass(frozen=True, slots=True)
class Steps:
    """Steps between neighbouring rows, by the sampler's rule.

    Attributes:
        count: their number.
        too_far: number of steps larger than `max_step_deg`.
        median_deg: their median.
        max_step_deg: the sampler's limit.
    """

    count: int
    too_far: int
    median_deg: float
    max_step_deg: float

    @classmethod
    def of(cls, recording: Recording, robot: RobotDescription, rules: DaemonConfig) -> Steps:
        """Return the steps of a recording of at least two rows."""
        prismatic = robot.chain.prismatic
        units = np.where(prismatic, 1 / rules.metres_per_degree, 180 / np.pi)
        steps_deg = np.linalg.norm(joint_difference(recording.q[1:], recording.q[:-1], prismatic) * units, axis=1)
        too_far = int(np.count_nonzero(steps_deg > rules.max_step_deg))
        return cls(len(steps_deg), too_far, float(np.median(steps_deg)), rules.max_step_deg)

    @property
    def is_path(self) -> bool:
        """True if most rows follow from their predecessors."""
        return self.too_far <= MOST * self.count

    def __str__(self) -> str:
        return (
            f"{self.too_far} of {self.count} steps are larger than max_step_deg = {self.max_step_deg:g} "
            f"(median {self.median_deg:.1f}°)"
        )


def require_path(steps: Steps, recording: Recording) -> None:
    """Raise RecordingError if the rows are single poses far apart."""
    if not steps.is_path:
        raise RecordingError(
            f"{steps}: these are single poses, not a guided path, and the sampler's step and speed rules do not "
            "apply to them",
            file=recording.file or "recording",
            remedy="Give --any-step to relax these rules and accept every row, each as a segment of its own",
        )
