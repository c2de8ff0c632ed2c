"""Goals of inverse kinematics, a position or a pose, as errors that a step of the joints can lessen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.model import PoseModel, PositionModel
from kbmaps.rotations import rotation_vector


class Goal(Protocol):
    """Goal of inverse kinematics. Errors are in m, also those of an orientation."""

    def error(self, q: FloatArray) -> FloatArray:
        """Return the remaining error (m,) [m] at q (d,)."""
        ...

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Return the decrease of the error by a step of the joints, to first order (m, d)."""
        ...

    def reached(self, error: FloatArray) -> bool:
        """Return True if the error is within the tolerance."""
        ...


@dataclass(frozen=True, eq=False)
class PositionGoal:
    """Target position x (3,) [m] of the marker, to within the tolerance [m]."""

    model: PositionModel
    x: FloatArray
    tolerance: float

    def error(self, q: FloatArray) -> FloatArray:
        return self.x - self.model.predict(q)

    def jacobian(self, q: FloatArray) -> FloatArray:
        return self.model.jacobian(q)

    def reached(self, error: FloatArray) -> bool:
        return float(error @ error) <= self.tolerance**2


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """Target position x (3,) [m] of the marker with the orientation `rotation` (3, 3).

    Attributes:
        lever: the length [m] at which a radian of orientation counts as much as the arc that it makes.
        tolerance, angle_tolerance: errors that count as reached [m], [rad].
    """

    model: PoseModel
    x: FloatArray
    rotation: FloatArray
    lever: float
    tolerance: float
    angle_tolerance: float

    def error(self, q: FloatArray) -> FloatArray:
        turn = rotation_vector(self.rotation @ self.model.orientation(q, orthonormal=True).T)
        return np.concatenate([self.x - self.model.predict(q), self.lever * turn])

    def jacobian(self, q: FloatArray) -> FloatArray:
        return np.concatenate([self.model.jacobian(q), self.lever * self.model.angular_jacobian(q)])

    def reached(self, error: FloatArray) -> bool:
        distance, angle = np.linalg.norm(error[:3]), np.linalg.norm(error[3:]) / self.lever
        return bool(distance <= self.tolerance and angle <= self.angle_tolerance)
