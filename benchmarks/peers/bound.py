"""Posterior error of the right model with the right prior, linearised at the truth."""

from __future__ import annotations

import numpy as np

from benchmarks.peers.tasks import Trial
from benchmarks.rough_arm import RoughArm
from kbmaps.arrays import FloatArray

_DRAWS = 64
# Prior standard deviation [rad, m] without tolerances: so wide that the pairs decide, and still a proper prior.
_UNTOLD = 10.0


def bounds(trial: Trial) -> dict[str, float]:
    """Return the expected mean error [m] of each test of the trial; empty if the right model is not a rigid chain."""
    arm, problem = trial.arm, trial.problem
    if arm is None or problem.sigma is None:
        return {}
    parameters = arm.parameters
    std = np.full(parameters.size, _UNTOLD)
    if problem.tolerances is not None:
        std = parameters.standard_deviations(problem.tolerances)
    precision = np.eye(parameters.size)
    if trial.before is not None and problem.tool_move is not None:
        precision += _information(arm, trial.before.q, std, problem.sigma)
        precision = _with_moved_tool(precision, parameters.tool, std, problem.tool_move)
    precision += _information(arm, problem.q, std, problem.sigma)
    draws = np.linalg.solve(
        np.linalg.cholesky(precision).T, np.random.default_rng(0).normal(size=(parameters.size, _DRAWS))
    )
    shown = {}
    for name, (q, _) in trial.tests.items():
        _, jacobian = parameters.linearised(arm.change, q)
        shown[name] = float(np.linalg.norm((jacobian * std) @ draws, axis=1).mean())
    return shown


def _information(arm: RoughArm, q: FloatArray, std: FloatArray, sigma: float) -> FloatArray:
    """Return the precision of the parameters in units of their prior's standard deviations, from pairs at q."""
    _, jacobian = arm.parameters.linearised(arm.change, q)
    design = (jacobian * std).reshape(3 * len(q), -1) / sigma
    return design.T @ design


def _with_moved_tool(precision: FloatArray, tool: slice, std: FloatArray, move: float) -> FloatArray:
    """Return the precision after the marker moved by about `move` [m] in an unknown direction."""
    covariance = np.linalg.inv(precision)
    index = np.arange(len(precision))[tool]
    covariance[index, index] += move**2 / 3.0 / std[tool] ** 2
    return np.asarray(np.linalg.inv(covariance), dtype=np.float64)
