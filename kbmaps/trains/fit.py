"""Most likely tensor train for given pairs: alternating least squares, then Levenberg–Marquardt."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from kbmaps import lapack
from kbmaps.arrays import FloatArray
from kbmaps.trains.core_prior import CORE_NUMBERS, CorePrior
from kbmaps.trains.train import apply, prefixes, suffixes


class _Settings:
    """Settings of the damping of a step.

    Sensitivity: each at 0.3 and 3 times changes error and sigma of a bent arm's models at 150 pairs by less than 1 %;
    not varied: `first_damping`.
    """

    first_damping: float = 1e-3
    smallest_damping: float = 1e-15
    largest_damping: float = 1e6
    smallest_gain: float = 1e-6  # a step that gains less than this share of the objective ends the search


@dataclass(frozen=True, eq=False)
class TensorProblem:
    """Pairs and prior: the objective Σ ‖(x − f(q)) / std‖² + ‖z‖² over the whitened cores z."""

    weights: FloatArray  # basis functions (n, d, 3)
    x: FloatArray  # positions (n, 3) [m]
    std: FloatArray  # of one coordinate of each pair (n,) [m]
    prior: CorePrior  # the Gaussian of which z is the standard form

    def maps(self, z: FloatArray) -> FloatArray:
        cores = self.prior.cores(z)
        flat = self.weights.swapaxes(0, 1) @ cores.reshape(len(cores), 3, 12)
        return flat.reshape(*flat.shape[:2], 3, 4)

    def residuals(self, z: FloatArray) -> FloatArray:
        """Return x − f(q) (n, 3) [m]."""
        return self.x - suffixes(self.maps(z))[0]

    def objective(self, z: FloatArray) -> float:
        scaled = self.residuals(z) / self.std[:, None]
        return float(np.square(scaled).sum() + z @ z)

    def scaled_jacobian(self, z: FloatArray) -> FloatArray:
        """Return the derivative of f / std by z (3 n, 36 d)."""
        return whitened_jacobian(self.weights, self.maps(z), self.prior) / np.repeat(self.std, 3)[:, None]


def whitened_jacobian(weights: FloatArray, maps: FloatArray, prior: CorePrior) -> FloatArray:
    """Return the derivative of the positions by z (3 n, 36 d), for basis functions (n, d, 3) and maps (d, n, 3, 4)."""
    linear, points = prefixes(maps), suffixes(maps)
    count, joints = weights.shape[:2]
    jacobian = np.empty((3 * count, CORE_NUMBERS * joints))
    for k in range(joints):
        block = _core_jacobian(linear[k], weights[:, k], points[k + 1])
        jacobian[:, CORE_NUMBERS * k : CORE_NUMBERS * (k + 1)] = block @ prior.spread[k]
    return jacobian


def _core_jacobian(linear: FloatArray, weights: FloatArray, points: FloatArray) -> FloatArray:
    """Return the derivative of the positions by one core (3 n, 36).

    Rows L[o, a] w[j] (r, 1)[b] at (pair, o), (j, a, b).
    """
    count = len(weights)
    right = np.empty((count, 3, 4))
    right[:, :, :3] = weights[:, :, None] * points[:, None, :]
    right[:, :, 3] = weights
    block = linear[:, :, None, :, None] * right[:, None, :, None, :]
    return block.reshape(3 * count, CORE_NUMBERS)


def alternate(problem: TensorProblem, z: FloatArray, sweeps: int) -> FloatArray:
    """Run alternating least squares: optimise each core in turn with the others fixed.

    Grasedyck, Kluge, Krämer 2015, section 3, for an affine train and with the prior as ridge.
    """
    z = z.copy()
    scale = np.repeat(1.0 / problem.std, 3)[:, None]
    spread = problem.prior.spread
    for _ in range(sweeps):
        maps = problem.maps(z)
        points = suffixes(maps)
        linear = np.broadcast_to(np.eye(3), (len(problem.x), 3, 3))
        ahead = np.zeros_like(problem.x)
        for k in range(maps.shape[0]):
            part = slice(CORE_NUMBERS * k, CORE_NUMBERS * (k + 1))
            rows = _core_jacobian(linear, problem.weights[:, k], points[k + 1]) @ spread[k]
            rows *= scale
            miss = problem.x - ahead - (linear @ apply(maps[k], points[k + 1])[:, :, None])[:, :, 0]
            normal = rows.T @ rows
            normal[np.diag_indices(CORE_NUMBERS)] += 1.0 + _Settings.smallest_damping * normal.trace()
            factor, _ = lapack.cholesky_lower(np.asfortranarray(normal))
            step = lapack.cholesky_solve(factor, rows.T @ (miss.ravel() * scale[:, 0]) - z[part])
            z[part] += step
            change = (spread[k] @ step).reshape(3, 12)
            maps[k] += (problem.weights[:, k] @ change).reshape(-1, 3, 4)
            ahead = ahead + (linear @ maps[k][:, :, 3:])[:, :, 0]
            linear = linear @ maps[k][:, :, :3]
    return z


@dataclass
class LevenbergMarquardt:
    """Damped Gauss–Newton on a TensorProblem.

    The damping is a multiple of the identity in whitened cores. Gauge freedoms (an affine change of the frame between
    two cores) need no further treatment: along them, the step follows the prior alone.
    """

    damping: float = _Settings.first_damping
    iterations: int = 0
    converged: bool = field(default=False, init=False)

    def run(self, problem: TensorProblem, z: FloatArray, limit: int) -> tuple[FloatArray, float]:
        """Return z and its objective after at most `limit` steps."""
        value = problem.objective(z)
        self.converged = False
        for _ in range(limit):
            self.iterations += 1
            jacobian = problem.scaled_jacobian(z)
            residual = (problem.residuals(z) / problem.std[:, None]).ravel()
            normal, dual = _normal_matrix(jacobian)
            before = value
            while self.damping <= _Settings.largest_damping:
                step = _damped_step(jacobian, normal, dual, residual, z, self.damping)
                trial = np.inf if step is None else problem.objective(z + step)
                if step is not None and trial < value:
                    z, value = z + step, trial
                    self.damping = max(0.1 * self.damping, _Settings.smallest_damping)
                    break
                self.damping *= 10.0
            else:
                self.damping = _Settings.first_damping
                self.converged = True
                return z, value
            if before - value <= _Settings.smallest_gain * before:
                self.converged = True
                return z, value
        return z, value


def _normal_matrix(jacobian: FloatArray) -> tuple[FloatArray, bool]:
    """Return the smaller of JᵀJ and JJᵀ, and True if it is the latter."""
    dual = jacobian.shape[0] < jacobian.shape[1]
    return (jacobian @ jacobian.T if dual else jacobian.T @ jacobian), dual


def _damped_step(
    jacobian: FloatArray, normal: FloatArray, dual: bool, residual: FloatArray, z: FloatArray, damping: float
) -> FloatArray | None:
    """Return the damped step δ; None if the matrix is not positive definite.

    δ minimises ‖residual − J δ‖² + ‖z + δ‖² + damping·mean(diag JᵀJ) ‖δ‖².
    """
    shift = 1.0 + damping * float(normal.trace()) / jacobian.shape[1]
    shifted = np.array(normal, order="F")
    shifted[np.diag_indices(len(normal))] += shift
    factor, positive = lapack.cholesky_lower(shifted)
    if not positive:
        return None
    if not dual:
        return lapack.cholesky_solve(factor, jacobian.T @ residual - z)
    return jacobian.T @ lapack.cholesky_solve(factor, residual + jacobian @ z / shift) - z / shift
