"""How far from rigid an arm is, as its pairs tell: the evidence of a family of priors of the cores."""

from __future__ import annotations

import math

import numpy as np

from kbmaps import lapack
from kbmaps.arrays import FloatArray
from kbmaps.trains.core_prior import CORE_NUMBERS, CoreFamily, CorePrior
from kbmaps.trains.fit import TensorProblem, whitened_jacobian

# What is tried, and what is believed before the pairs: a few parts in a thousand, give or take a decade.
ELLIPSE_STDS = tuple(float(std) for std in np.geomspace(1e-4, 3e-2, 11))
USUAL_ELLIPSE_STD = 0.003
_DECADE = math.log(10.0)


def core_information(problem: TensorProblem, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """H (36 d, 36 d) and h (36 d,) of a problem linearised at z: its log likelihood is -½ (cᵀ H c - 2 hᵀ c) + …"""
    prior = problem.prior
    plain = CorePrior(prior.mean, np.tile(np.eye(CORE_NUMBERS), (prior.joints, 1, 1)))
    maps = problem.maps(z)
    jacobian = whitened_jacobian(problem.weights, maps, plain) / np.repeat(problem.std, 3)[:, None]
    residuals = (problem.residuals(z) / problem.std[:, None]).ravel()
    information = jacobian.T @ jacobian
    return information, jacobian.T @ residuals + information @ prior.cores(z).ravel()


def likely_ellipse_std(family: CoreFamily, information: FloatArray, pull: FloatArray) -> float:
    """The most probable of `ELLIPSE_STDS`, for what pairs tell of the cores c (36 d,), linearised at a fit to them.

    With c = m + S z, z ~ N(0, I) and the pairs' log likelihood -½ (cᵀ H c - 2 hᵀ c), z marginalised,

        2 log p = (h - H m)ᵀ S (I + Sᵀ H S)⁻¹ Sᵀ (h - H m) - log |I + Sᵀ H S| + terms without S.

    Args:
        information, pull: H (36 d, 36 d) and h (36 d,).
    """
    slope = pull - information @ family.mean.ravel()
    scores = [
        _evidence(family.prior(std), information, slope) - 0.5 * (math.log(std / USUAL_ELLIPSE_STD) / _DECADE) ** 2
        for std in ELLIPSE_STDS
    ]
    return ELLIPSE_STDS[int(np.argmax(scores))]


def _evidence(prior: CorePrior, information: FloatArray, slope: FloatArray) -> float:
    joints = prior.joints
    blocks = information.reshape(joints, CORE_NUMBERS, joints, CORE_NUMBERS)
    whitened = np.einsum("aij,aibk,bkl->ajbl", prior.spread, blocks, prior.spread, optimize=True)
    matrix = np.asfortranarray(whitened.reshape(information.shape) + np.eye(len(information)))
    pull = (prior.spread.swapaxes(1, 2) @ slope.reshape(joints, CORE_NUMBERS, 1)).ravel()
    factor, positive = lapack.cholesky_lower(matrix)
    if not positive:
        return -math.inf
    return 0.5 * float(pull @ lapack.cholesky_solve(factor, pull)) - float(np.log(np.diag(factor)).sum())
