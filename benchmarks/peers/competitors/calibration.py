"""Least-squares calibration with scipy, and the unchanged nominal model.

The method of calibration toolboxes (FIGAROH; Hollerbach, Khalil and Gautier 2008): small placement errors of every
joint frame, reduced to the identifiable ones by a pivoted QR of the regressor; then Levenberg-Marquardt, no prior.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import qr
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.peers.problem import Competitor, Fitted, Problem, drawn, needs_drawing
from kbmaps import RigidChain
from kbmaps.arrays import FloatArray, IntArray

_RANK_TOLERANCE = 1e-6
_MOST_EVALUATIONS = 100


@dataclass(frozen=True)
class Placements:
    """A chain whose d + 1 fixed transforms are each followed by a small motion: a rotation [rad] and a shift [m]."""

    chain: RigidChain
    change: FloatArray

    def predict(self, q: FloatArray) -> FloatArray:
        return self.linearised(self.change, q)[0]

    def linearised(self, change: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions (n, 3) and derivatives (n, 3, 6 d + 6) by the change (rotation, shift), frame by frame."""
        motions = change.reshape(-1, 6)
        rotation, origin = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
        rotations: list[FloatArray] = []
        origins: list[FloatArray] = []
        for k, fixed in enumerate(self.chain.fixed):
            origin = origin + rotation @ fixed[:3, 3]
            rotation = rotation @ fixed[:3, :3]
            rotations.append(rotation)
            origin = origin + rotation @ motions[k, 3:]
            origins.append(origin)
            rotation = rotation @ Rotation.from_rotvec(motions[k, :3]).as_matrix()
            if k < self.chain.joints:
                rotation = rotation @ Rotation.from_rotvec(q[:, k, None] * self.chain.axes[k]).as_matrix()
        jacobian = np.empty((len(q), 3, change.size))
        for k in range(len(motions)):
            lever = origin - origins[k]
            directions = rotations[k] @ _left_jacobian(motions[k, :3])
            jacobian[:, :, 6 * k : 6 * k + 3] = np.cross(directions, lever[:, :, None], axis=1)
            jacobian[:, :, 6 * k + 3 : 6 * k + 6] = rotations[k]
        return origin, jacobian


def _left_jacobian(turn: FloatArray) -> FloatArray:
    """Return J with exp(φ + δ) = exp(J δ) exp(φ) to first order (Chirikjian 2012, section 10.8)."""
    angle = float(np.linalg.norm(turn))
    if angle < 1e-6:
        return np.eye(3)
    axis = turn / angle
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + (1.0 - np.cos(angle)) / angle * cross + (1.0 - np.sin(angle) / angle) * (cross @ cross)


def identifiable(model: Placements, q: FloatArray) -> IntArray:
    """Return the indices of the parameters identifiable from q (pivoted QR of the regressor at the present change)."""
    _, jacobian = model.linearised(model.change, q)
    flat = jacobian.reshape(3 * len(q), -1)
    # scipy's stubs lack the third result that pivoting adds, and a function as jac below.
    factors: Any = qr(flat, mode="r", pivoting=True)
    triangle, pivots = factors
    diagonal = np.abs(np.diag(triangle))
    rank = int((diagonal > _RANK_TOLERANCE * diagonal[0]).sum())
    return np.sort(pivots[:rank]).astype(np.intp)


def learn(problem: Problem, earlier: Fitted | None) -> Fitted:
    if problem.drawing is None:
        raise ValueError("calibration starts from a drawing")
    start = Placements(problem.drawing, np.zeros(6 * (problem.joints + 1)))
    if isinstance(earlier, Placements):
        # Only the tool has changed: recalibrate its three parameters, keep the rest.
        start = earlier
        free = np.arange(start.change.size)[-3:]
    else:
        free = identifiable(start, problem.q)

    def with_free(values: FloatArray) -> FloatArray:
        change = start.change.copy()
        change[free] = values
        return change

    def derivatives(values: FloatArray) -> FloatArray:
        return start.linearised(with_free(values), problem.q)[1][:, :, free].reshape(-1, len(free))

    fit = least_squares(
        lambda values: (start.linearised(with_free(values), problem.q)[0] - problem.x).ravel(),
        start.change[free],
        jac=derivatives,  # pyright: ignore[reportArgumentType]
        method="lm",
        x_scale="jac",
        max_nfev=_MOST_EVALUATIONS,
    )
    return Placements(problem.drawing, with_free(fit.x))


def _all_turn(problem: Problem) -> str | None:
    return "written for turning joints" if problem.drawing is not None and problem.drawing.prismatic.any() else None


def _learn_nothing(problem: Problem, earlier: Fitted | None) -> Fitted:
    del earlier
    if problem.drawing is None:
        raise ValueError("there is no drawing")
    return drawn(problem.drawing)


COMPETITORS = (
    Competitor(
        "calibration",
        "Least-squares calibration",
        "peer",
        learn,
        "scipy.optimize.least_squares (Levenberg-Marquardt) on the identifiable placement errors of all joint frames, "
        "no prior, as FIGAROH does; after a tool change the tool's three numbers only.",
        lambda problem: needs_drawing(problem) or _all_turn(problem),
        calibrates=True,
    ),
    Competitor(
        "drawing",
        "Drawing as it is",
        "peer",
        _learn_nothing,
        "Learns nothing: the nominal chain.",
        needs_drawing,
        calibrates=True,
    ),
)
