"""Rows with noise on rigid arms: pairs drawn independently, a zone, figure 6's stream, a guided walk, outliers."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import partial

import numpy as np

from benchmarks import tensor_train
from benchmarks.goals.goal import Figure, Row, at_most
from benchmarks.goals.study import Study, Values, first_below, mean, ratio, worst
from benchmarks.rigid_learner import DRAWINGS, SIGMA, STAGES, found_error, guided_fits, local_fit, noisy_fit, spoilt_fit
from bodyschema.reproduce.arm import JOINTS, arm, longer_tool
from bodyschema.reproduce.fig6 import MOVED_M
from bodyschema.reproduce.walk import WALK_SIGMA, walk
from kbmaps import ChainTolerances, RigidLearner
from kbmaps.arrays import FloatArray

_FEW = (24, 26, 28, 30, 32, 36)
_FEW_FOUND = (30, 35, 40, 45)
_FEW_TRAIN = (120, 150, 180)
_STREAM_SIGMA = 0.020
_TEST_ROWS = 500
_ROUGH = "rough drawing (2 deg, 10 mm)"


def _few(seed: int) -> Values:
    fits = {pairs: noisy_fit(pairs, seed) for pairs in _FEW}
    near = {f"after {pairs}": fit.near for pairs, fit in fits.items()}
    return near | {f"bound {pairs}": fit.near_bound for pairs, fit in fits.items()}


def _few_found(seed: int) -> Values:
    return {f"after {pairs}": found_error(pairs, seed) for pairs in _FEW_FOUND}


def _few_train(seed: int) -> Values:
    tasks = {pairs: tensor_train.Task(6, pairs, SIGMA) for pairs in _FEW_TRAIN}
    return {f"after {pairs}": 1e3 * tensor_train.run(task, seed).mean for pairs, task in tasks.items()}


def _many(pairs: int, seed: int) -> Values:
    return asdict(noisy_fit(pairs, seed))


def _pairs_needed(counts: tuple[int, ...], start: str = "after") -> dict[int, str]:
    return {pairs: f"{start} {pairs}" for pairs in counts}


def _few_rows() -> list[Row]:
    few, found, train = (
        (Study("sigma 10 mm, rough drawing, few pairs", _few, seeds=200),),
        (Study("sigma 10 mm, from nothing, few pairs", _few_found, seeds=100),),
        (Study("sigma 10 mm, train from nothing, few pairs", _few_train, seeds=50),),
    )
    sigma_mm = 1e3 * SIGMA
    rough, nothing, trains = (_pairs_needed(counts) for counts in (_FEW, _FEW_FOUND, _FEW_TRAIN))
    several = [(pairs, (Study(f"sigma 10 mm, {pairs} pairs", partial(_many, pairs)),)) for pairs in (300, 2200)]
    goals = {300: (3.0, 4.2), 2200: (1.05, 1.6)}
    return [
        Row(
            "few",
            "d = 6, σ = 10 mm, ±80°: mean error below σ",
            (
                Figure(
                    "rigid chain, rough nominal model: pairs until then",
                    few,
                    first_below(rough, sigma_mm),
                    at_most(30, "pairs"),
                    first_below(_pairs_needed(_FEW, "bound"), sigma_mm),
                ),
                Figure(
                    "the same: error after 30 pairs", few, mean("after 30"), at_most(sigma_mm, "mm"), mean("bound 30")
                ),
                Figure(
                    "rigid chain, from nothing: pairs until then",
                    found,
                    first_below(nothing, sigma_mm),
                    at_most(40, "pairs"),
                ),
                Figure("the same: error after 40 pairs", found, mean("after 40"), at_most(sigma_mm, "mm")),
                Figure(
                    "tensor train, from nothing: pairs until then",
                    train,
                    first_below(trains, sigma_mm),
                    at_most(150, "pairs"),
                ),
                Figure("the same: error after 150 pairs", train, mean("after 150"), at_most(sigma_mm, "mm")),
            ),
        ),
        Row(
            "many",
            "the same arm, rough nominal model, rigid chain, more pairs",
            tuple(
                Figure(f"{pairs:,} pairs, ±{reach}°", study, mean(name), at_most(goal, "mm"), mean(f"{name}_bound"))
                for pairs, study in several
                for reach, name, goal in zip((80, 120), ("near", "wide"), goals[pairs], strict=True)
            ),
        ),
    ]


def _stream(seed: int) -> Values:
    """Run figure 6's walk: the arm is known, and its marker was moved by 250 mm."""
    rng = np.random.default_rng(seed)
    known = arm(7)
    true = longer_tool(known, MOVED_M)
    q = walk(rng, STAGES[-1], JOINTS[7])
    x, noise = true.positions(q), _STREAM_SIGMA * rng.normal(size=(len(q), 3))
    test = WALK_SIGMA * rng.normal(size=(_TEST_ROWS, known.joints))

    def error_mm(pairs: int, measured: FloatArray) -> float:
        learner = RigidLearner(known, ChainTolerances(tool=1.0))
        learner.learn(q[:pairs], measured[:pairs])
        return 1e3 * float(np.linalg.norm(learner.predict(test) - true.positions(test), axis=1).mean())

    noisy = {f"after {pairs}": error_mm(pairs, x + noise) for pairs in STAGES}
    return noisy | {"noise-free after 1": error_mm(1, x)}


def _guided(drawing: str, seed: int) -> Values:
    values: dict[str, float] = {}
    for stage, fit in zip(STAGES, guided_fits(drawing, seed), strict=True):
        values |= {f"{name} {stage}": value for name, value in asdict(fit).items()}
    return values


def _stream_rows() -> list[Row]:
    stream = (Study("figure 6's stream, sigma 20 mm", _stream),)
    rough = (Study("guided walk, rough drawing", partial(_guided, _ROUGH)),)
    calibrated = (Study("guided walk, calibrated drawing", partial(_guided, next(iter(DRAWINGS)))),)
    first, last = STAGES[0], STAGES[-1]
    return [
        Row(
            "stream",
            "figure 6's stream, σ = 20 mm, calibrated nominal model, poses anywhere (normal, 22°)",
            (
                Figure("tool alone free, 30 pairs", stream, mean("after 30"), at_most(6.5, "mm")),
                Figure("tool alone free, 1,700 pairs", stream, mean("after 1700"), at_most(1.0, "mm")),
                Figure("tool alone free, noise-free, 1 pair", stream, mean("noise-free after 1"), at_most(0.1, "mm")),
                *(
                    Figure(
                        f"the same on a guided walk, {stage:,} pairs",
                        calibrated,
                        mean(f"off {stage}"),
                        at_most(goal, "mm"),
                        mean(f"off_bound {stage}"),
                    )
                    for stage, goal in ((first, 6.5), (last, 1.0))
                ),
            ),
        ),
        Row(
            "guided",
            "guided walk, σ = 20 mm, rough nominal model (2°, 10 mm), tool moved",
            tuple(
                Figure(
                    f"{stage:,} pairs, {where}",
                    rough,
                    mean(f"{name} {stage}"),
                    at_most(goal, "mm"),
                    mean(f"{name}_bound {stage}"),
                )
                for name, where, goals in (("off", "off the walk", (27.0, 8.0)), ("near", "near the walk", (15.0, 4.0)))
                for stage, goal in zip((first, last), goals, strict=True)
            ),
        ),
    ]


def _local(seed: int) -> Values:
    error, bound, _, _ = local_fit(seed)
    return {"error": error, "bound": bound}


def _spoilt(pairs: int, seed: int) -> Values:
    spoilt, good = spoilt_fit(pairs, seed)
    return {"spoilt": spoilt, "good": good, "ratio": spoilt / good if good > 0.0 else math.inf}


def _other_rows() -> list[Row]:
    local = (Study("zone of +-20 deg, 300 pairs", _local, seeds=200),)
    spoilt = [(pairs, (Study(f"outliers, {pairs} pairs", partial(_spoilt, pairs)),)) for pairs in (50, 200, 1000)]
    return [
        Row(
            "local",
            "local ±20°, 300 pairs, σ = 10, error at ±80°",
            (
                Figure(
                    "rigid chain, rough nominal model, d = 6", local, mean("error"), at_most(15.0, "mm"), mean("bound")
                ),
            ),
        ),
        Row(
            "outliers",
            "15 % of the pairs off by 200 mm, over the same learner given only the good pairs",
            tuple(
                figure
                for pairs, study in spoilt
                for figure in (
                    Figure(f"{pairs:,} pairs: ratio of mean errors", study, ratio("spoilt", "good"), at_most(1.05)),
                    Figure(f"{pairs:,} pairs: ratio, worst seed", study, worst("ratio"), at_most(1.05)),
                )
            ),
        ),
    ]


def rows() -> list[Row]:
    return [*_few_rows(), *_stream_rows(), *_other_rows()]
