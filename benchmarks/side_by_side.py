"""Several models learn side by side; the one that best predicted the pairs before learning them answers.

This is what the daemon's learner does, without processes: residual, rigid chain and tensor train around a nominal
model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps import (
    ChainTolerances,
    Estimate,
    KBMapsError,
    Model,
    PrequentialComparison,
    ResidualLearner,
    RigidChain,
    RigidLearner,
    TensorLearner,
    learning_bases,
)

# A model learns the new pairs once they are this share of those it has learnt.
_GROWTH = 0.25


class SideBySide:
    """Residual, rigid chain and tensor train, the most trusted first; the train does not answer away from its data."""

    def __init__(self, nominal: RigidChain, tolerances: ChainTolerances, lower: FloatArray, upper: FloatArray) -> None:
        train = TensorLearner.around(
            nominal,
            learning_bases(lower, upper, nominal.prismatic.tolist()),
            turn_std=_proper(tolerances.axes, math.radians(3.0)),
            shift_std=_proper(tolerances.points, 0.015),
            marker_std=_proper(tolerances.tool, 0.03),
        )
        self._models: dict[str, Model] = {
            "residual": ResidualLearner(nominal, tolerances),
            "rigid": RigidLearner(nominal, tolerances),
            "train": train,
        }
        self._contest, self._failed = PrequentialComparison(), set[str]()
        self._answering = "residual"

    def learn(self, q: FloatArray, x: FloatArray, sigma: float | None = None) -> None:
        """Learn all pairs q (n, d) and x (n, 3) once, in order."""
        learnt = dict.fromkeys(self._models, 0)
        begin = 0
        while begin < len(q):
            due = {name: count + max(1.0, _GROWTH * count) for name, count in learnt.items()}
            until = min(len(q), max(begin + 1, math.ceil(min(due.values()))))
            self._compare(q[begin:until], x[begin:until])
            for name in [name for name in due if until >= due[name]]:
                self._teach(name, q[learnt[name] : until], x[learnt[name] : until], sigma)
                learnt[name] = until
            begin = until
        self._choose()
        while learnt[self._answering] < len(q):
            since = learnt[self._answering]
            learnt[self._answering] = len(q)
            self._teach(self._answering, q[since:], x[since:], sigma)
            self._choose()

    def predict(self, q: FloatArray) -> FloatArray:
        """Return positions (n, 3) at q (n, d)."""
        return self.estimate(q).x

    def estimate(self, q: FloatArray) -> Estimate:
        """Return positions at q (n, d) with their uncertainty."""
        found = self._models[self._answering].estimate(q)
        outside = ~found.in_support
        if self._answering != "train" or not outside.any():
            return found
        working = [name for name in self._working if name != "train"]
        instead = self._models[self._contest.best(working, working[0])].estimate(q[outside])
        x, spread = found.x.copy(), found.sigma.copy()
        x[outside], spread[outside] = instead.x, instead.sigma
        return Estimate(x, spread, found.in_support)

    @property
    def _working(self) -> Sequence[str]:
        return [name for name in self._models if name not in self._failed]

    def _compare(self, q: FloatArray, x: FloatArray) -> None:
        squares = {name: np.square(x - self._models[name].predict(q)).sum(axis=1) for name in self._working}
        for k in range(len(q)):
            self._contest.add({name: float(values[k]) for name, values in squares.items()})

    def _teach(self, name: str, q: FloatArray, x: FloatArray, sigma: float | None) -> None:
        model = self._models[name]
        try:
            model.learn(q, x, sigma)
            failed = not np.isfinite(model.predict(q[-1:])).all()
        except (KBMapsError, ArithmeticError, np.linalg.LinAlgError):
            failed = True
        if failed:
            self._failed.add(name)
            self._contest.forget(name)
        else:
            self._failed.discard(name)

    def _choose(self) -> None:
        self._answering = self._contest.best(self._working, self._answering)


def _proper(tolerance: float, default: float) -> float:
    """Return a tolerance that is valid for a Gaussian prior."""
    return tolerance if 0.0 < tolerance < math.inf else default
