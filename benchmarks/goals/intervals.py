"""The row on the models' claimed uncertainty."""

from __future__ import annotations

from functools import partial

from benchmarks import coverage
from benchmarks.coverage import BENT_GOAL, MODELS, ONE_SIGMA_GOAL, TWO_SIGMA_GOAL, Task
from benchmarks.goals.goal import Figure, Row, at_least, between
from benchmarks.goals.study import Estimate, Study, Values, highest, lowest

_SEEDS = 200
_PERCENT = 100.0
_NOISY = (
    Task(6, 30),
    Task(6, 100),
    Task(6, 300),
    Task(7, 300),
    Task(7, 300, reach_deg=0.0, test_deg=60.0),
    Task(6, 300, reach_deg=20.0, test_deg=60.0),
    Task(6, 100, outliers=0.15),
)
_BENT = tuple(Task(6, 100, reach_deg=40.0, bend=kind) for kind in ("sag", "eccentric", "gain", "affine", "radial"))
_JUDGED = ("rigid, batch", "residual")


def _shares(model: str, task: Task, seed: int) -> Values:
    outcome = coverage.run(task, MODELS[model], seed)
    return {"one": _PERCENT * outcome.one, "two": _PERCENT * outcome.two}


def _figures(model: str) -> list[Figure]:
    def studies(tasks: tuple[Task, ...]) -> tuple[Study, ...]:
        return tuple(Study(f"intervals: {model}, {task.name}", partial(_shares, model, task), _SEEDS) for task in tasks)

    figures: list[Figure] = []
    for name, text, (low, high) in (("one", "1 σ", ONE_SIGMA_GOAL), ("two", "1.96 σ", TWO_SIGMA_GOAL)):
        ends: tuple[tuple[str, Estimate], ...] = (("lowest", lowest(name)), ("highest", highest(name)))
        goal = between(_PERCENT * low, _PERCENT * high, "%")
        figures += [
            Figure(f"{model}: within {text}, the {end} of {len(_NOISY)} tasks", studies(_NOISY), estimate, goal)
            for end, estimate in ends
        ]
    figures += [
        Figure(
            f"{model}, arms that are not rigid, ±40° to ±80°: within {text}, the lowest of {len(_BENT)} tasks",
            studies(_BENT),
            lowest(name),
            at_least(_PERCENT * least, "%"),
        )
        for name, text, least in (("one", "1 σ", BENT_GOAL[0]), ("two", "1.96 σ", BENT_GOAL[1]))
    ]
    return figures


def rows() -> list[Row]:
    figures = tuple(figure for model in _JUDGED for figure in _figures(model))
    return [
        Row("intervals", "predicted intervals: share of true coordinates inside, 100 pairs where not rigid", figures)
    ]
