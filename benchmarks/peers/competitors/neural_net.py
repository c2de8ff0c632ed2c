"""A multi-layer perceptron (scikit-learn)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.peers.problem import Competitor, Fitted, Offset, Problem
from kbmaps.arrays import FloatArray

if TYPE_CHECKING:
    from sklearn.neural_network import MLPRegressor

_HIDDEN = (48, 48)
_ITERATIONS = 400
_WEIGHT_DECAY = 1e-2


@dataclass(frozen=True)
class _Net:
    offset: Offset
    scale: float
    net: MLPRegressor

    def predict(self, q: FloatArray) -> FloatArray:
        return self.offset.predict(q) + self.scale * np.asarray(self.net.predict(_features(q)))


def _features(q: FloatArray) -> FloatArray:
    return np.concatenate([np.cos(q), np.sin(q)], axis=1)


def learn(problem: Problem, earlier: Fitted | None) -> Fitted:
    # It takes a second to import.
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor

    offset = Offset.of(problem, earlier)
    rest = problem.x - offset.predict(problem.q)
    scale = max(float(rest.std()), 1e-9)
    net = MLPRegressor(
        hidden_layer_sizes=_HIDDEN,
        activation="tanh",
        solver="lbfgs",
        alpha=_WEIGHT_DECAY * problem.pairs,
        max_iter=_ITERATIONS,
        random_state=int(problem.rng.integers(2**31)),
    )
    with warnings.catch_warnings():
        # The iterations are the budget.
        warnings.simplefilter("ignore", ConvergenceWarning)
        net.fit(_features(problem.q), rest / scale)
    return _Net(offset, scale, net)


COMPETITOR = Competitor(
    "mlp",
    "Multi-layer perceptron",
    "peer",
    learn,
    "scikit-learn MLPRegressor, 2 x 48 tanh units on sines and cosines of the angles, L-BFGS, weight decay; learns the "
    "errors of the drawing, or of its own model before a tool change.",
)
