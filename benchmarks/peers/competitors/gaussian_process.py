"""Gaussian process regression (scikit-learn)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from benchmarks.peers.problem import Competitor, Fitted, Offset, Problem
from kbmaps.arrays import FloatArray

# Marginal likelihoods cost n³ each, so the kernel is found on so many pairs and then used on all.
_PAIRS_FOR_KERNEL = 200


@dataclass(frozen=True)
class _Regression:
    offset: Offset
    scale: float
    process: GaussianProcessRegressor
    problem: Problem

    def predict(self, q: FloatArray) -> FloatArray:
        return self.offset.predict(q) + self.scale * np.asarray(self.process.predict(self.problem.scaled(q)))


def learn(problem: Problem, earlier: Fitted | None) -> Fitted:
    offset = Offset.of(problem, earlier)
    rest = problem.x - offset.predict(problem.q)
    scale = max(float(rest.std()), 1e-9)
    q, y = problem.scaled(problem.q), rest / scale
    start = ConstantKernel(1.0) * RBF(np.full(problem.joints, 1.5), (0.1, 100.0)) + WhiteKernel(0.05, (1e-8, 2.0))
    few = slice(0, _PAIRS_FOR_KERNEL)
    with warnings.catch_warnings():
        # A length scale at its limit is an answer here: that joint does not matter.
        warnings.simplefilter("ignore", ConvergenceWarning)
        kernel = GaussianProcessRegressor(start).fit(q[few], y[few]).kernel_
    return _Regression(offset, scale, GaussianProcessRegressor(kernel, optimizer=None).fit(q, y), problem)


COMPETITOR = Competitor(
    "gp",
    "Gaussian process",
    "peer",
    learn,
    "scikit-learn GaussianProcessRegressor, one length scale a joint and white noise, by marginal likelihood on at "
    "most 200 pairs, then all pairs; learns the errors of the drawing, or of its own model before a tool change.",
)
