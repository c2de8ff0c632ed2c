"""Benchmark runs resume where they stopped, and the page shows all of them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.peers.bound import bounds
from benchmarks.peers.chart import apart
from benchmarks.peers.page import write_page
from benchmarks.peers.problem import Competitor, Fitted, Problem, drawn
from benchmarks.peers.registry import BY_KEY, COMPETITORS
from benchmarks.peers.results import Growth, Outcome, Results, cell, machine
from benchmarks.peers.runner import Plan, run
from benchmarks.peers.summary import summary
from benchmarks.peers.tasks import Setting, Task, simulated_tasks

TASK = Task("tiny", "A tiny task", Setting(joints=4), counts=(30,))


def plan(competitors: list[Competitor], **changes: object) -> Plan:
    return replace(Plan([TASK], competitors, 2, float("inf"), 20.0, 300), **changes)


def run_quietly(a_plan: Plan, results: Results) -> bool:
    return run(a_plan, results, lambda job, outcomes: None)


def loop_for_ever(problem: Problem, earlier: Fitted | None) -> Fitted:
    del problem, earlier
    while True:
        pass


def diverge(problem: Problem, earlier: Fitted | None) -> Fitted:
    del earlier
    assert problem.drawing is not None
    return drawn(problem.drawing.with_tool([1e6, 0.0, 0.0]))


def test_a_run_is_taken_up_where_it_stopped(tmp_path):
    path, results = tmp_path / "peers.json", Results()
    run_quietly(plan([BY_KEY["drawing"]]), results)
    results.save(path)
    again = Results.load(path)
    assert again.outcomes == results.outcomes
    assert again.bounds == results.bounds
    never = replace(BY_KEY["drawing"], learn=loop_for_ever)
    assert run_quietly(plan([never]), again)
    assert again.outcomes == results.outcomes


def test_nothing_is_begun_after_the_deadline():
    results = Results()
    assert not run_quietly(plan([BY_KEY["drawing"]], deadline_s=0.0), results)
    assert not results.outcomes


def test_slow_fit_ends_growth():
    results = Results()
    slow = Competitor("slow", "Slow", "peer", loop_for_ever, "")
    run_quietly(plan([slow], fit_limit_s=0.05), results)
    assert {outcome.status for outcome in results.outcomes.values()} == {"too slow"}


def test_a_divergence_counts_as_a_failure():
    results = Results()
    run_quietly(plan([Competitor("wild", "Wild", "peer", diverge, "")]), results)
    summary = cell(results.of("tiny", "wild", 30), "drawn alike")
    assert summary.mean is None
    assert summary.failed == 2
    assert "diverged" in summary.reason


def test_mean_and_standard_error_cover_finished_seeds():
    values = [0.01, 0.02, 0.03]
    outcomes = [Outcome("t", "c", 30, seed, "ok", {"x": value}) for seed, value in enumerate(values)]
    summary = cell([*outcomes, Outcome("t", "c", 30, 3, "failed", reason="NaN")], "x")
    assert summary.mean == pytest.approx(0.02)
    assert summary.standard_error == pytest.approx(0.01 / np.sqrt(3.0))
    assert (summary.ran, summary.failed) == (4, 1)


def test_the_bound_is_what_the_right_model_reaches():
    errors, floors = [], []
    for seed in range(25):
        trial = Setting(joints=4)(seed, 100)
        q, x = trial.tests["drawn alike"]
        fitted = BY_KEY["rigid"].learn(trial.problem, None)
        errors.append(np.linalg.norm(fitted.predict(q) - x, axis=1).mean())
        floors.append(bounds(trial)["drawn alike"])
    assert np.mean(errors) == pytest.approx(np.mean(floors), rel=0.15)


def test_bound_is_absent_for_non_rigid_truth():
    bent = next(task for task in simulated_tasks() if task.key == "sag1").trial(0, 30)
    assert bent is not None
    assert bounds(bent) == {}


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> str:
    results = Results(runs=[machine() | {"when": "now", "seconds": 1, "arguments": "a test"}])
    for task in simulated_tasks():
        for competitor in COMPETITORS:
            for pairs, error in ((30, 0.02), (100, 0.01)):
                outcome = Outcome(task.key, competitor.key, pairs, 0, "ok", {"drawn alike": error}, 0.1, 1.0)
                results.outcomes[outcome.key] = outcome
        results.bounds[task.key, 30, 0, "drawn alike"] = 0.015
    results.growth = [Growth("joints", "nlms", d, 1e-4 * 3**d, 0.1) for d in (2, 3, 4)]
    file = tmp_path_factory.mktemp("page") / "peers.html"
    write_page(file, results, simulated_tasks(), COMPETITORS)
    return file.read_text()


def test_the_page_has_every_task_with_a_chart(page):
    sections = {
        key: page.split(f'<section id="{key}">')[1].split("</section>")[0] for key in (t.key for t in simulated_tasks())
    }
    assert all("<polyline" in section for section in sections.values())


def test_page_describes_every_competitor(page):
    assert all(f"<code>{competitor.key}</code>" in page for competitor in COMPETITORS)


def test_the_page_says_that_recordings_were_not_run(page):
    assert "no folder given" in page


def test_the_page_needs_nothing_from_elsewhere(page):
    assert not re.search(r"""\ssrc\s*=|href\s*=\s*["'](?!#)|https?:|@import|url\(""", page)


def test_a_competitor_has_one_colour_in_all_charts(page):
    colours = re.findall(r'<g data-model="rigid"><title>[^<]*</title><polyline fill="none" stroke="(#\w+)"', page)
    assert len(colours) >= len(simulated_tasks())
    assert len(set(colours)) == 1


def test_best_competitors_are_named_at_line_ends(page):
    section = page.split('<section id="rough6">')[1].split("</section>")[0]
    assert len(re.findall(r'<text class="end"', section)) == 5


def test_a_single_seed_is_not_called_a_mean(page):
    assert "One seed only" in page
    assert "Means over" not in page


def test_line_labels_stay_apart_within_chart():
    placed = apart([10.0, 11.0, 279.0, 280.0, 280.0])
    assert min(np.diff(placed)) >= 14.0
    assert max(placed) <= 280.0


def test_tables_show_task_means_with_best_bold():
    drawing, psom = BY_KEY["drawing"], BY_KEY["psom"]
    results = Results()
    for key, error_m in (("drawing", 4e-3), ("psom", 0.12)):
        for seed in range(2):
            outcome = Outcome("tiny", key, 30, seed, "ok", {"drawn alike": error_m})
            results.outcomes[outcome.key] = outcome
    [said] = summary(results, [TASK], [drawing, psom])
    assert said.name == "peers_30"
    assert "| task, 2 arms | floor |" in said.markdown()
    assert "| A tiny task |  | **4.0** | 120 |" in said.markdown()
