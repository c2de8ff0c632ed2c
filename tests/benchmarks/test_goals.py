"""The table of target figures: measurement, judgement, and its presence on the page."""

from __future__ import annotations

import math
import re
import sys
from functools import partial
from pathlib import Path

import pytest

from benchmarks.goals import __main__ as command
from benchmarks.goals import not_rigid, registry
from benchmarks.goals.goal import Figure, Goal, Row, Verdict, at_least, at_most, between, judged
from benchmarks.goals.results import Results
from benchmarks.goals.study import (
    Estimate,
    NotHereError,
    Study,
    Values,
    first_below,
    highest,
    lowest,
    mean,
    ratio,
    share_below,
)
from benchmarks.goals.table import overview, table

RESULTS = Path(__file__).parents[2] / "docs" / "results"
PAGE = (RESULTS / "goals_table.md").read_text(encoding="utf-8")


def nothing(seed: int) -> Values:
    raise AssertionError(f"seed {seed} was measured")


STUDY = Study("some study", nothing, seeds=3)


TWO = at_most(2.0)


def a_figure(goal: Goal = TWO, bound: Estimate | None = None) -> Figure:
    return Figure("some figure", (STUDY,), mean("error"), goal, bound)


def values(*errors: float) -> dict[str, list[Values]]:
    return {STUDY.key: [{"error": error, "bound": 4.0} for error in errors]}


def test_page_has_all_rows_in_table_order():
    rows = registry.rows(None)
    assert re.findall(r"^\| \*\*(\S+)\*\*: (.*?) \|", PAGE, re.MULTILINE) == [(row.name, row.what) for row in rows]
    assert re.findall(r"^\| – (.*?) \|", PAGE, re.MULTILINE) == [one.what for row in rows for one in row.figures]


def test_the_summary_has_every_row():
    summary = (RESULTS / "goals.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\| \*\*(\S+)\*\*: .* \| \d+ of (\d+) \|", summary, re.MULTILINE)
    assert shown == [(row.name, str(len(row.figures))) for row in registry.rows(None)]


def test_the_overview_counts_figures_and_goals():
    shown = overview([Row("some", "something", (a_figure(),))], {}).markdown()
    assert "| **some**: something | 0 of 1 | not measured |" in shown
    assert "| all | 0 of 1 | 0 of 1 met |" in shown


def test_results_key_identifies_one_way_of_measuring():
    runs: dict[str, set[object]] = {}
    for study in (study for row in registry.rows(None) for figure in row.figures for study in figure.studies):
        run = study.run
        way = (run.func, run.args) if isinstance(run, partial) else run
        runs.setdefault(study.key, set()).add(way)
    assert [key for key, ways in runs.items() if len(ways) > 1] == []


def test_known_seed_is_not_measured_again(tmp_path):
    path = tmp_path / "goals.json"
    first = Results(path)
    for seed in range(command.FIRST_SEED, command.FIRST_SEED + 3):
        first.add(STUDY, seed, {"error": 1.0})
    first.save()
    again = Results(path)
    command.measure([Row("some", "something", (a_figure(),))], again, None, math.inf)
    assert again.values() == {STUDY.key: [{"error": 1.0}] * 3}


def test_runs_side_by_side_keep_each_other_s_seeds(tmp_path):
    path = tmp_path / "goals.json"
    one, other = Results(path), Results(path)
    one.add(STUDY, 1000, {"error": 1.0})
    other.add(STUDY, 1001, {"error": 2.0})
    one.save()
    other.save()
    assert Results(path).values() == {STUDY.key: [{"error": 1.0}, {"error": 2.0}]}


def test_forgotten_result_does_not_return_from_file(tmp_path):
    results = Results(tmp_path / "goals.json")
    results.add(STUDY, 1000, {"error": 1.0})
    results.save()
    results.forget([STUDY])
    results.save()
    assert Results(tmp_path / "goals.json").values() == {}


def test_nothing_is_begun_after_the_deadline(tmp_path):
    results = Results(tmp_path / "goals.json")
    command.measure([Row("some", "something", (a_figure(),))], results, None, -math.inf)
    assert results.values() == {}


def test_study_without_its_data_is_skipped(tmp_path, capsys):
    def missing(seed: int) -> Values:
        raise NotHereError(f"nothing is there for {seed}")

    good = Study("another study", lambda seed: {"error": float(seed)}, seeds=1)
    figures = tuple(Figure("f", (study,), mean("error"), at_most(1.0)) for study in (Study("lost", missing), good))
    results = Results(tmp_path / "goals.json")
    command.measure([Row("some", "something", figures)], results, None, math.inf)
    assert results.values() == {good.key: [{"error": float(command.FIRST_SEED)}]}
    assert "nothing is there for 1000" in capsys.readouterr().err


def test_recorded_row_without_recordings_says_what_to_give():
    row = next(row for row in registry.rows(None) if row.name == "ur5")
    with pytest.raises(NotHereError, match="--data"):
        row.studies[0].run(0)


@pytest.mark.parametrize(
    ("goal", "bound", "error", "verdict"),
    [
        (at_most(2.0), None, 2.0, Verdict.MET),
        (at_most(2.0), None, 2.1, Verdict.NOT_MET),
        (at_most(2.0), "bound", 4.5, Verdict.MET),
        (at_most(2.0), "bound", 4.7, Verdict.NOT_MET),
        (at_most(5.0), "bound", 4.9, Verdict.MET),
        (at_least(2.0), None, 1.9, Verdict.NOT_MET),
        (between(1.0, 2.0), None, 0.5, Verdict.NOT_MET),
    ],
)
def test_goal_is_number_or_bound_plus_15_percent(goal, bound, error, verdict):
    cell = judged(a_figure(goal, mean(bound) if bound else None), values(error, error))
    assert cell.verdict is verdict


def test_goal_within_two_standard_errors_is_undecided():
    assert judged(a_figure(), values(1.0, 2.0, 2.5)).in_doubt
    assert not judged(a_figure(), values(1.0, 1.1, 1.2)).in_doubt


@pytest.mark.parametrize(("errors", "standing"), [([1.0], "met"), ([3.0], "**not met**"), ([], "not measured")])
def test_a_row_stands_as_its_worst_figure(errors, standing):
    other = Figure("met", (Study("met", nothing, seeds=1),), mean("error"), at_most(1.0))
    shown = table([Row("some", "something", (other, a_figure()))], values(*errors) | {"met": [{"error": 0.0}]})
    assert shown.markdown().splitlines()[2].endswith(f"| {standing} |")


def test_ladder_is_compared_with_best_model_per_truth(monkeypatch):
    models = {"rigid": None, "residual": None, not_rigid.ANSWER: None}
    monkeypatch.setattr(not_rigid, "MODELS", models)
    row = next(row for row in registry.rows(None) if row.name == "ladder")
    # At 100 pairs 1.1 times as large as the residual learner's everywhere, elsewhere equal to the rigid chain's.
    errors = {"rigid": 2.0, "residual": 1.0}
    known = {
        study.key: [{"error": errors.get(study.key.split(", ")[-1], 1.1 if "100 pairs" in study.key else 2.0)}]
        for study in row.studies
    }
    measured = [judged(figure, known).measured for figure in row.figures]
    assert [one.value for one in measured if one] == pytest.approx([1.1, 2.0, 2.0, 2.0, (1.1 * 2.0**3) ** 0.25])


def test_estimates():
    one, other = [{"a": 1.0, "b": 2.0}, {"a": 3.0, "b": 2.0}], [{"a": 6.0, "b": 1.0}]
    assert mean("a")([one]).value == 2.0
    assert mean("a")([one]).standard_error == pytest.approx(1.0)
    assert ratio("a", "b")([one]).value == 1.0
    assert share_below("a", 1.0)([one]).value == 50.0
    assert (lowest("a")([one, other]).value, highest("a")([one, other]).value) == (2.0, 6.0)


@pytest.mark.parametrize(("level", "size"), [(5.0, 10.0), (2.0, 20.0), (0.5, math.inf)])
def test_size_reaching_level_is_interpolated(level, size):
    estimate = first_below({10: "n10", 40: "n40"}, level)
    assert estimate([[{"n10": 4.0, "n40": 1.0}]]).value == pytest.approx(size)


def test_unknown_row_error_lists_known_rows(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["goals", "--rows", "nonsense", "--json", str(tmp_path / "goals.json")])
    with pytest.raises(SystemExit, match=r"nonsense; there are net, net-20"):
        command.main()
