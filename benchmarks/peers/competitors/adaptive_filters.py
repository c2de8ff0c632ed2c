"""Adaptive filters (padasip) on the features of a KB-Map: one filter for each coordinate."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.peers.competitors.maps import start_map
from benchmarks.peers.problem import Competitor, Fitted, Problem, at_most
from kbmaps import KBMap
from kbmaps.arrays import FloatArray

if TYPE_CHECKING:
    from padasip.filters import FilterNLMS, FilterRLS

_STEP = 0.5
_PASSES = 4
# Forgetting next to none, and a first covariance of the size that suits metres.
_RLS_MEMORY, _RLS_FIRST = 0.99999, 1.0
_MOST_JOINTS_NLMS, _MOST_JOINTS_RLS = 8, 5


@dataclass(frozen=True)
class Filters:
    """Three filters on the weights of `kbmap`'s bases."""

    kbmap: KBMap
    filters: list[Any]

    def predict(self, q: FloatArray) -> FloatArray:
        planes = np.array([single.w for single in self.filters])
        return KBMap(self.kbmap.bases, planes.reshape(self.kbmap.net.shape)).predict(q)


def learn(make: Callable[[FloatArray], Any], passes: int, problem: Problem, earlier: Fitted | None) -> Fitted:
    if isinstance(earlier, Filters):
        learnt = Filters(earlier.kbmap, copy.deepcopy(earlier.filters))
    else:
        start = start_map(problem)
        learnt = Filters(start, [make(plane.ravel()) for plane in start.net])
    for run in range(passes):
        order = np.arange(problem.pairs) if run == 0 else problem.rng.permutation(problem.pairs)
        for index in order:
            features = learnt.kbmap.weights(problem.q[index])
            for single, target in zip(learnt.filters, problem.x[index], strict=True):
                single.adapt(target, features)
    return learnt


def _nlms(weights: FloatArray) -> FilterNLMS:
    from padasip.filters import FilterNLMS  # it imports all of scipy.stats

    return FilterNLMS(weights.size, mu=_STEP, eps=1e-12, w=weights)


def _rls(weights: FloatArray) -> FilterRLS:
    from padasip.filters import FilterRLS

    return FilterRLS(weights.size, mu=_RLS_MEMORY, eps=_RLS_FIRST, w=weights)


COMPETITORS = (
    Competitor(
        "padasip-nlms",
        "padasip NLMS",
        "peer",
        partial(learn, _nlms, 1 + _PASSES),
        "padasip FilterNLMS on the features of the KB-Map, step 0.5, one pass and four replays in random order; starts "
        "from the drawing's control points where there is one, and goes on after a tool change.",
        at_most(_MOST_JOINTS_NLMS, "3^d features a pair are too slow beyond 8 joints"),
    ),
    Competitor(
        "padasip-rls",
        "padasip RLS",
        "peer",
        partial(learn, _rls, 1),
        "padasip FilterRLS on the features of the KB-Map, one pass; starts as padasip NLMS does.",
        at_most(
            _MOST_JOINTS_RLS,
            "a covariance of 3^d x 3^d for each coordinate is too slow beyond 5 joints (0.1 s a pair at 6)",
        ),
    ),
)
