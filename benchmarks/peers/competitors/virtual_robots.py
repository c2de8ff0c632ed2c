"""Decomposition into virtual robots (Ruiz de Angulo and Torras 2005, IEEE Trans. Neural Networks 16; 2008, SMC-B 38).

The arm is cut behind its first half of joints. With q = (a, b), reference poses a0 and b0, and T(a) the pose of the
hand while the last joints rest at b0, every position follows from two much shorter arms:

    x(a, b) = T(a) T(a0)⁻¹ x(a0, b)

The first virtual robot, T(a), needs the hand's orientation: three markers are read at each pose, which counts as three
readings. The second one is the marker while the first joints rest. Each is learnt at its own poses: by PSOMs as in
the papers, or by KB-Maps (Ulbrich et al. 2012 combine the two).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.peers.competitors.psom import Grid, interpolated, nodes_for
from benchmarks.peers.problem import Competitor, Fitted, Problem, any_of, needs_measuring
from kbmaps import ExactLearner, KBMap, learning_bases
from kbmaps.arrays import FloatArray

# Markers two and three sit so far from the first along the hand's x and y axes [m].
BASELINE_M = 0.1
_MARKERS = np.array([[0.0, 0.0, 0.0], [BASELINE_M, 0.0, 0.0], [0.0, BASELINE_M, 0.0]])
_MOST_CONTROL_POINTS = 3**6

# Learns one virtual robot from at most so many poses: (low, high, poses, read) -> its models, one a marker.
Read = Callable[[FloatArray], list[FloatArray]]
LearnPart = Callable[[FloatArray, FloatArray, int, Read, np.random.Generator], list[Fitted]]


@dataclass(frozen=True)
class VirtualRobots:
    """Two learnt parts, and the number of joints of the first one."""

    first: list[Fitted]
    second: Fitted
    split: int
    rest_rotation: FloatArray
    rest_origin: FloatArray

    def predict(self, q: FloatArray) -> FloatArray:
        rotation, origin = hand_pose([part.predict(q[:, : self.split]) for part in self.first])
        x_rest = (self.second.predict(q[:, self.split :]) - self.rest_origin) @ self.rest_rotation
        return origin + np.einsum("nij,nj->ni", rotation, x_rest)


def hand_pose(markers: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return rotations (n, 3, 3), re-orthonormalised, and origins (n, 3) from three markers (n, 3)."""
    x, y = (markers[1] - markers[0]) / BASELINE_M, (markers[2] - markers[0]) / BASELINE_M
    u, _, vt = np.linalg.svd(np.stack([x, y, np.cross(x, y)], axis=2))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt, markers[0]


def learn(learn_part: LearnPart, problem: Problem, earlier: Fitted | None) -> Fitted:
    del earlier
    split, first, second = shares(problem)
    measure = problem.measure
    if measure is None:
        raise ValueError("virtual robots need an arm that goes to the poses they ask for")
    rest = 0.5 * (problem.low + problem.high)

    def whole(part: FloatArray, begin: int) -> FloatArray:
        q = np.tile(rest, (len(part), 1))
        q[:, begin : begin + part.shape[1]] = part
        return q

    low, high = problem.low, problem.high
    pose = learn_part(
        low[:split],
        high[:split],
        first,
        lambda part: [measure(whole(part, 0), shift) for shift in _MARKERS],
        problem.rng,
    )
    marker = learn_part(
        low[split:], high[split:], second, lambda part: [measure(whole(part, split), _MARKERS[0])], problem.rng
    )
    rotation, origin = hand_pose([part.predict(rest[None, :split]) for part in pose])
    return VirtualRobots(pose, marker[0], split, rotation[0], origin[0])


def shares(problem: Problem) -> tuple[int, int, int]:
    """Return the joints of the first part, and the poses of both: the first gets half the readings, at three a pose."""
    split = problem.joints // 2
    second = problem.pairs * 2 // 5
    return split, (problem.pairs - second) // 3, second


def psom_part(low: FloatArray, high: FloatArray, poses: int, read: Read, rng: np.random.Generator) -> list[Fitted]:
    del rng
    nodes = nodes_for(len(low), poses)
    if nodes is None:
        raise ValueError(f"{poses} poses are no grid for {len(low)} joints")
    grid = Grid(low, high, nodes)
    return [interpolated(grid, x) for x in read(grid.poses())]


def kb_part(low: FloatArray, high: FloatArray, poses: int, read: Read, rng: np.random.Generator) -> list[Fitted]:
    bases = learning_bases(low, high)
    q = rng.uniform(low, high, (poses, len(low)))
    parts: list[Fitted] = []
    for x in read(q):
        learner = ExactLearner(KBMap(bases, np.zeros((3, *(3,) * len(low)))))
        learner.learn(q, x)
        parts.append(learner.solve("evidence").map)
    return parts


def _too_few_for_grids(problem: Problem) -> str | None:
    split, first, second = shares(problem)
    if nodes_for(split, first) and nodes_for(problem.joints - split, second):
        return None
    return f"grids of 2 poses a joint for both parts take more than {problem.pairs} readings"


def _too_many_control_points(problem: Problem) -> str | None:
    if 3 ** (problem.joints - problem.joints // 2) > _MOST_CONTROL_POINTS:
        return "3^(d/2) control points a part are too many beyond 12 joints"
    return None


COMPETITORS = (
    Competitor(
        "virtual-psom",
        "Virtual robots, PSOM",
        "peer",
        partial(learn, psom_part),
        "Decomposition into two virtual robots (Ruiz de Angulo and Torras 2005, 2008), each a PSOM on its own grid; "
        "the first reads three markers a pose (three readings), so it is told orientations; poses of its own choosing.",
        any_of(needs_measuring, _too_few_for_grids),
    ),
    Competitor(
        "virtual-kb",
        "Virtual robots, KB-Map",
        "peer",
        partial(learn, kb_part),
        "The same decomposition with a KB-Map for each part, from random poses of that part.",
        any_of(needs_measuring, _too_many_control_points),
    ),
)
