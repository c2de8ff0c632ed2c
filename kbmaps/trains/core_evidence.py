"""Non-rigidity of an arm, estimated from its pairs by the evidence of a family of priors of the cores."""

from __future__ import annotations

import math

import numpy as np

from kbmaps import lapack
from kbmaps.arrays import FloatArray
from kbmaps.trains.core_prior import CORE_NUMBERS, CoreFamily, CorePrior
from kbmaps.trains.fit import TensorProblem, whitened_jacobian

# Candidates, and the centre of the prior over them: a few parts in a thousand, within about a decade.
ELLIPSE_STDS = tuple(float(std) for std in np.geomspace(1e-4, 3e-2, 11))
USUAL_ELLIPSE_STD = 0.003
_DECADE = math.log(10.0)


def core_equations(problem: TensorProblem, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return J (3 n, 36 d) and y (3 n,) of a problem linearised at z.

    y = J c + e for cores c (36 d,), with e ~ N(0, I).
    """
    prior = problem.prior
    plain = CorePrior(prior.mean, np.tile(np.eye(CORE_NUMBERS), (prior.joints, 1, 1)))
    jacobian = whitened_jacobian(problem.weights, problem.maps(z), plain) / np.repeat(problem.std, 3)[:, None]
    residuals = (problem.residuals(z) / problem.std[:, None]).ravel()
    return jacobian, residuals + jacobian @ prior.cores(z).ravel()


def likely_ellipse_std(family: CoreFamily, jacobian: FloatArray, positions: FloatArray) -> float:
    """Return the most probable of `ELLIPSE_STDS`, for pairs linearised at a fit to them.

    With c = m + S z, z ~ N(0, I), y - J m = r and z marginalised,

        2 log p = - rᵀ (I + J S Sᵀ Jᵀ)⁻¹ r - log |I + J S Sᵀ Jᵀ| + terms without S,

    or, where there are fewer cores' numbers than coordinates,

        2 log p = rᵀ J S (I + Sᵀ Jᵀ J S)⁻¹ Sᵀ Jᵀ r - log |I + Sᵀ Jᵀ J S| + terms without S.

    Args:
        family: the priors to choose from.
        jacobian, positions: J (3 n, 36 d) and y (3 n,) of `core_equations`.
    """
    residuals = positions - jacobian @ family.mean.ravel()
    few = len(jacobian) < jacobian.shape[1]
    evidences = _by_coordinates(family, jacobian, residuals) if few else _by_cores(family, jacobian, residuals)
    scores = [
        evidence - 0.5 * (math.log(std / USUAL_ELLIPSE_STD) / _DECADE) ** 2
        for std, evidence in zip(ELLIPSE_STDS, evidences, strict=True)
    ]
    return ELLIPSE_STDS[int(np.argmax(scores))]


def _by_coordinates(family: CoreFamily, jacobian: FloatArray, residuals: FloatArray) -> list[float]:
    """Return the log evidence of each of `ELLIPSE_STDS`, from matrices of the size of the coordinates.

    S Sᵀ is the rigid part plus the square of each standard deviation times the rest.
    """
    joints = len(family.mean)
    blocks = jacobian.reshape(-1, joints, CORE_NUMBERS).swapaxes(0, 1)
    moved = (blocks @ family.motions).swapaxes(0, 1).reshape(len(jacobian), -1)
    own = jacobian * np.tile(family.sizes, joints)
    rigid, rest = np.eye(len(jacobian)) + moved @ moved.T, own @ own.T
    evidences: list[float] = []
    for std in ELLIPSE_STDS:
        square, log_determinant = _inverse_square(rigid + std**2 * rest, residuals)
        evidences.append(-0.5 * (square + log_determinant))
    return evidences


def _by_cores(family: CoreFamily, jacobian: FloatArray, residuals: FloatArray) -> list[float]:
    """Return the log evidence of each of `ELLIPSE_STDS`."""
    joints, size = len(family.mean), jacobian.shape[1]
    blocks = (jacobian.T @ jacobian).reshape(joints, CORE_NUMBERS, joints, CORE_NUMBERS)
    slope = (jacobian.T @ residuals).reshape(joints, CORE_NUMBERS, 1)
    evidences: list[float] = []
    for std in ELLIPSE_STDS:
        spread = family.prior(std).spread
        whitened = np.einsum("aij,aibk,bkl->ajbl", spread, blocks, spread, optimize=True).reshape(size, size)
        pull = (spread.swapaxes(1, 2) @ slope).ravel()
        square, log_determinant = _inverse_square(whitened + np.eye(size), pull)
        evidences.append(0.5 * (square - log_determinant))
    return evidences


def _inverse_square(matrix: FloatArray, vector: FloatArray) -> tuple[float, float]:
    """Return vᵀ M⁻¹ v and log |M|, which is infinite where M is not positive definite up to rounding."""
    factor, positive = lapack.cholesky_lower(np.asfortranarray(matrix))
    if not positive:
        return 0.0, math.inf
    return float(vector @ lapack.cholesky_solve(factor, vector)), 2.0 * float(np.log(np.diag(factor)).sum())
