"""Rows without noise: numbers of pairs that determine an arm exactly."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks import exactness, tensor_train
from benchmarks.goals.goal import Figure, Row, at_least, at_most
from benchmarks.goals.study import Study, Values, mean, median, share_below, worst
from benchmarks.rigid_learner import exact_from_drawing, exact_from_nothing
from benchmarks.rough_arm import ROUGH
from benchmarks.tensor_train import Task, random_chain
from kbmaps import (
    ChainParameters,
    ExactLearner,
    JointBasis,
    RigidChain,
    RigidLearner,
    learning_bases,
    prediction_errors,
)

_ALPHAS_DEG = (20.0, 30.0, 45.0, 60.0, 70.0)
_JOINTS = range(2, 8)
_REACH, _SLIDE_M = np.radians(80.0), 0.3
_TEST_ROWS = 500
_PERCENT = 100.0
# Times as many pairs as control points.
_A_FEW_MORE = 1.05
# Below this a map is exact [m].
_EXACT_M = 1e-9


def _full_net(seed: int) -> Values:
    """Learn as many pairs as control points, for each number of joints; the mixed chain's size varies by seed."""
    rng = np.random.default_rng(seed)
    alpha = np.radians(_ALPHAS_DEG[seed % len(_ALPHAS_DEG)])
    turning = {joints: _net_error(random_chain(joints, rng), alpha, rng) for joints in _JOINTS}
    more, _ = _net_error(random_chain(_JOINTS[-1], rng), alpha, rng, _A_FEW_MORE)
    slides = np.arange(_JOINTS[seed % len(_JOINTS)]) % 2 == seed % 4 // 2
    chain = random_chain(len(slides), rng)
    mixed, _ = _net_error(RigidChain(chain.fixed, chain.axes, rng.permutation(slides).astype(np.bool_)), alpha, rng)
    errors = {f"d={joints}": error for joints, (error, _) in turning.items()}
    return errors | {"turning": max(errors.values()), "more": more, "mixed": mixed, "s": turning[_JOINTS[-1]][1]}


def _net_error(chain: RigidChain, alpha: float, rng: np.random.Generator, times: float = 1.0) -> tuple[float, float]:
    """Return the mean error [m] over full turns of the solution as a net with this alpha, and its CPU time [s]."""
    reach = np.where(chain.prismatic, _SLIDE_M, _REACH)
    turn = np.where(chain.prismatic, _SLIDE_M, np.pi)
    net = tuple(
        JointBasis.prismatic(-_SLIDE_M, _SLIDE_M) if slides else JointBasis.bernstein(alpha)
        for slides in chain.prismatic
    )
    prior = random_chain(chain.joints, rng)
    prior_map = RigidChain(prior.fixed, prior.axes, chain.prismatic).to_kbmap(net)
    size = round(times * np.prod([basis.size for basis in net]))
    q, test = rng.uniform(-reach, reach, (size, chain.joints)), rng.uniform(-turn, turn, (_TEST_ROWS, chain.joints))
    x = chain.positions(q)
    begin = time.process_time()
    learner = ExactLearner(prior_map, learning_bases(-reach, reach, chain.prismatic.tolist()))
    learner.learn(q, x)
    learnt = learner.solve().map
    seconds = time.process_time() - begin
    return float(prediction_errors(learnt, test, chain.positions(test)).mean()), seconds


def _cluster(seed: int) -> Values:
    errors = exactness.errors(7, 20.0, 2, seed)
    return {"mean": float(errors.mean()), "largest": float(errors.max())}


def _train(task: Task, seed: int) -> Values:
    outcome = tensor_train.run(task, seed)
    return {"m": outcome.mean, "exact": _PERCENT * (outcome.largest < tensor_train.EXACT_M), "s": outcome.seconds}


def _rigid_from_drawing(pairs: int, seed: int) -> Values:
    return {"exact": _PERCENT * (1e-3 * exact_from_drawing(pairs, seed) < _EXACT_M)}


def _rigid_from_nothing(pairs: int, reach_deg: float, seed: int) -> Values:
    error_mm, seconds = exact_from_nothing(pairs, reach_deg, seed)
    return {"m": 1e-3 * error_mm, "exact": _PERCENT * (1e-3 * error_mm < _EXACT_M), "s": seconds}


def _rigid_rough(joints: int, pairs: int, seed: int) -> Values:
    """Run the rigid chain on the tensor train's task: random links, rough nominal model."""
    rng = np.random.default_rng(seed)
    parameters = ChainParameters(random_chain(joints, rng))
    change = parameters.standard_deviations(ROUGH) * rng.normal(size=parameters.size)
    q, test = (rng.uniform(-_REACH, _REACH, (n, joints)) for n in (pairs, _TEST_ROWS))
    begin = time.process_time()
    learner = RigidLearner(parameters.reference, ROUGH)
    learner.learn(q, parameters.positions(change, q))
    predicted = learner.predict(test)
    seconds = time.process_time() - begin
    error = float(np.linalg.norm(predicted - parameters.positions(change, test), axis=1).mean())
    return {"exact": _PERCENT * (error < _EXACT_M), "s": seconds}


def _exact_in_time(what: str, key: str, run: Callable[[int], Values], share: float, limit_s: float) -> list[Figure]:
    studies = (Study(key, run),)
    return [
        Figure(f"{what}: share of seeds exact", studies, mean("exact"), at_least(share, "%")),
        Figure(f"{what}: CPU time, median", studies, median("s"), at_most(limit_s, "s")),
    ]


def _net_row() -> Row:
    net = (Study("full net, noise-free", _full_net),)
    return Row(
        "net",
        "noise-free, 3^d random pairs over ±80°, α in 20…70°, error on ±180°",
        (
            Figure(
                "d = 2…7 turning joints: mean error, worst seed and d", net, worst("turning"), at_most(_EXACT_M, "m")
            ),
            Figure("the same at d = 7: median seed", net, median("d=7"), at_most(_EXACT_M, "m")),
            Figure("the same at d = 7 from 5 % more pairs: worst seed", net, worst("more"), at_most(_EXACT_M, "m")),
            Figure(
                "mixed chains, 3^R·2^P pairs: mean error, median seed", net, median("mixed"), at_most(_EXACT_M, "m")
            ),
            Figure("mixed chains, 3^R·2^P pairs: mean error, worst seed", net, worst("mixed"), at_most(_EXACT_M, "m")),
            Figure("fit at d = 7: CPU time, worst seed", net, worst("s"), at_most(2.0, "s")),
        ),
    )


def _far_row() -> Row:
    cluster = (Study("full net, from +-20 deg", _cluster, seeds=20),)
    return Row(
        "net-20",
        "noise-free cluster ±20°, twice 3^d pairs, d = 7, full map, error on ±80°",
        (
            Figure("mean error, median seed", cluster, median("mean"), at_most(1e-7, "m")),
            Figure("mean error, worst seed", cluster, worst("mean"), at_most(1e-7, "m")),
        ),
    )


def _cluster_row() -> Row:
    return Row(
        "cluster-5",
        "noise-free cluster ±5°, d = 7, error on ±80°",
        (
            Figure(
                "rigid chain from nothing, 60 pairs: mean error, worst seed",
                (Study("rigid, 60 pairs within +-5 deg", partial(_rigid_from_nothing, 60, 5.0)),),
                worst("m"),
                at_most(1e-7, "m"),
            ),
            Figure(
                "tensor train from nothing, 150 pairs: share of seeds with a mean error ≤ 1e-7 m",
                (Study("train, 150 pairs within +-5 deg", partial(_train, Task(7, 150, reach_deg=5.0))),),
                share_below("m", 1e-7),
                at_least(95.0, "%"),
            ),
        ),
    )


def _train_row() -> Row:
    return Row(
        "train",
        "tensor train from nothing, d = 7, exact",
        tuple(_exact_in_time("110 pairs", "train, 110 pairs", partial(_train, Task(7, 110)), 95.0, 2.0)),
    )


def _rough_row() -> Row:
    rough = tensor_train.ROUGH
    return Row(
        "rough-exact",
        "exact from a rough prior, many joints",
        tuple(
            figure
            for joints, pairs in ((20, 200), (30, 300))
            for figure in (
                *_exact_in_time(
                    f"tensor train, d = {joints}, {pairs} pairs",
                    f"train, rough prior, d={joints}, {pairs} pairs",
                    partial(_train, Task(joints, pairs, prior=rough)),
                    95.0,
                    5.0,
                ),
                *_exact_in_time(
                    f"rigid chain, d = {joints}, {pairs} pairs",
                    f"rigid, rough prior, d={joints}, {pairs} pairs",
                    partial(_rigid_rough, joints, pairs),
                    95.0,
                    5.0,
                ),
            )
        ),
    )


def _rigid_row() -> Row:
    return Row(
        "rigid",
        "rigid chain, d = 7, exact",
        (
            Figure(
                "15 pairs, from the nominal model: share of seeds exact",
                (Study("rigid, 15 pairs from the drawing", partial(_rigid_from_drawing, 15)),),
                mean("exact"),
                at_least(95.0, "%"),
            ),
            Figure(
                "60 pairs, from nothing: share of seeds exact",
                (Study("rigid, 60 pairs from nothing", partial(_rigid_from_nothing, 60, 80.0)),),
                mean("exact"),
                at_least(95.0, "%"),
            ),
        ),
    )


def rows() -> list[Row]:
    return [_net_row(), _far_row(), _cluster_row(), _train_row(), _rough_row(), _rigid_row()]
