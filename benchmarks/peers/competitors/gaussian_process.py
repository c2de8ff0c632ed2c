"""Gaussian process regression (scikit-learn)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.peers.problem import Competitor, Fitted, Offset, Problem
from kbmaps.arrays import FloatArray

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor

# Marginal likelihoods cost n³ each, so the kernel is found on so many pairs and then used on all.
_PAIRS_FOR_KERNEL = 200
# In units of the working range scaled to -1 .. 1.
_FIRST_SCALE = 1.5


@dataclass(frozen=True)
class _Regression:
    offset: Offset
    scale: float
    process: GaussianProcessRegressor
    problem: Problem

    def predict(self, q: FloatArray) -> FloatArray:
        predicted: Any = self.process.predict(self.problem.scaled(q))
        return self.offset.predict(q) + self.scale * predicted


def learn(problem: Problem, earlier: Fitted | None) -> Fitted:
    # It takes a second to import.
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    offset = Offset.of(problem, earlier)
    rest = problem.x - offset.predict(problem.q)
    scale = max(float(rest.std()), 1e-9)
    q, y = problem.scaled(problem.q), rest / scale
    scales: Any = np.full(problem.joints, _FIRST_SCALE)
    start = ConstantKernel(1.0) * RBF(scales, (0.1, 100.0)) + WhiteKernel(0.05, (1e-8, 2.0))
    few = slice(0, _PAIRS_FOR_KERNEL)
    with warnings.catch_warnings():
        # A length scale at its limit is an answer here: that joint does not matter.
        warnings.simplefilter("ignore", ConvergenceWarning)
        kernel = GaussianProcessRegressor(start).fit(q[few], y[few]).kernel_
    # The stubs of scikit-learn leave out that None means: keep the kernel as it is.
    process = GaussianProcessRegressor(kernel, optimizer=None)  # pyright: ignore[reportArgumentType]
    return _Regression(offset, scale, process.fit(q, y), problem)


COMPETITOR = Competitor(
    "gp",
    "Gaussian process",
    "peer",
    learn,
    "scikit-learn GaussianProcessRegressor, one length scale a joint and white noise, by marginal likelihood on at "
    "most 200 pairs, then all pairs; learns the errors of the drawing, or of its own model before a tool change.",
)
