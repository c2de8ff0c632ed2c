"""Rows on arms that are not quite rigid: simulated ones, and a measured one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.goals.goal import Figure, Row, at_most
from benchmarks.goals.study import Estimate, Measured, NotHereError, Study, Values, mean
from benchmarks.peers.__main__ import DATA_VARIABLE
from benchmarks.recording import Recording
from benchmarks.rough_truths import MODELS, recording_split, run

# The model of `MODELS` that is judged against the others.
ANSWER = "ladder"
_TRUTHS = ("sag1", "sag3", "eccentric", "gain", "affine", "lens")
# Pairs, and how many seeds.
_SIZES = {100: 50, 300: 50, 1000: 50, 3000: 50}
_RECORDING = "ur5_laser"
_FEW_POSES = 30


def _error(truth: str, model: str, pairs: int, seed: int) -> Values:
    return {"error": run(truth, model, pairs, seed, False)[0]}


def _studies(truth: str, pairs: int) -> dict[str, Study]:
    return {
        model: Study(f"not rigid: {truth}, {pairs} pairs, {model}", partial(_error, truth, model, pairs), _SIZES[pairs])
        for model in MODELS
    }


def _over_best(models: Sequence[str]) -> Estimate:
    """Estimate the mean error relative to the best single model, as a geometric mean over the set-ups."""
    return lambda samples: Measured(float(np.exp(np.mean(np.log(_ratios(models, samples))))))


def _most_over_best(models: Sequence[str]) -> Estimate:
    return lambda samples: Measured(max(_ratios(models, samples)))


def _ratios(models: Sequence[str], samples: Sequence[Sequence[Values]]) -> list[float]:
    """Return the error ratio of each set-up; samples are ordered by set-up, then by model."""
    ratios: list[float] = []
    for first in range(0, len(samples), len(models)):
        errors = {
            model: float(np.mean([values["error"] for values in seeds]))
            for model, seeds in zip(models, samples[first : first + len(models)], strict=True)
        }
        ratios.append(errors[ANSWER] / min(error for model, error in errors.items() if model != ANSWER))
    return ratios


def _ladder_row() -> Row:
    figures: list[Figure] = []
    every: list[Study] = []
    for pairs in _SIZES:
        studies = [study for truth in _TRUTHS for study in _studies(truth, pairs).values()]
        every += studies
        figures.append(
            Figure(
                f"{pairs:,} pairs: the model that answers over the best single one, the worst truth",
                tuple(studies),
                _most_over_best(tuple(MODELS)),
                at_most(1.2),
            )
        )
    figures.append(
        Figure("the same, geometric mean over truths and sizes", tuple(every), _over_best(tuple(MODELS)), at_most(1.05))
    )
    what = (
        "non-rigid truths (sag 1°, 3°; eccentric 1°; gain 1 %; camera 2–3 %; radial 2 %), over the best of "
        + ", ".join(model for model in MODELS if model != ANSWER)
    )
    return Row("ladder", what, tuple(figures))


def _split(data: Path | None, pairs: int | None, seed: int) -> Values:
    """Return held-out mean errors of a random split; None means to learn four fifths of the rows."""
    if data is None:
        raise NotHereError(f"no folder with recordings is given (--data FOLDER or {DATA_VARIABLE})")
    folder = data / _RECORDING
    if not folder.is_dir():
        raise NotHereError(f"there is no {folder}")
    known = Recording.load(folder)
    alone, whole = recording_split(known, 4 * len(known) // 5 if pairs is None else pairs, seed)
    return {"rigid": alone, "residual": whole}


def _recorded_row(data: Path | None) -> Row:
    folds = (Study("UR5, four fifths of the rows", partial(_split, data, None), seeds=50),)
    few = (Study("UR5, 30 poses", partial(_split, data, _FEW_POSES), seeds=50),)
    return Row(
        "ur5",
        "UR5 laser recording, mean error of held-out rows, rigid chain with residual",
        (
            Figure("from four fifths, random splits", folds, mean("residual"), at_most(0.090, "mm")),
            Figure("from 30 poses", few, mean("residual"), at_most(0.12, "mm")),
        ),
    )


def rows(data: Path | None) -> list[Row]:
    return [_ladder_row(), _recorded_row(data)]
