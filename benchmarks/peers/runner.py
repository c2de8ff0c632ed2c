"""Run competitors on tasks until all seeds are done or the time is up."""

from __future__ import annotations

import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.peers.bound import bounds
from benchmarks.peers.problem import Competitor, Fitted, Problem
from benchmarks.peers.results import DIVERGED_M, Outcome, Results
from benchmarks.peers.tasks import Task, Trial
from kbmaps import KBMapsError


class TooSlow(Exception):
    """A fit exceeded its time limit."""


@dataclass(frozen=True)
class Plan:
    """Plan of a run.

    Attributes:
        seeds: number of seeds, from 0.
        deadline_s: time on the clock at which to stop; the current fit is finished.
        fit_limit_s: CPU time after which a fit is abandoned.
        clock: returns seconds.
    """

    tasks: Sequence[Task]
    competitors: Sequence[Competitor]
    seeds: int
    deadline_s: float
    fit_limit_s: float
    most_pairs: int
    min_pairs: int = 0
    clock: Callable[[], float] = time.monotonic


@dataclass(frozen=True)
class Job:
    task: Task
    pairs: int
    seed: int


def jobs(plan: Plan) -> Iterator[Job]:
    """Yield every task at few pairs first, then the next seed; expensive sizes follow the cheap ones."""
    counts = sorted({n for task in plan.tasks for n in task.counts if plan.min_pairs <= n <= plan.most_pairs})
    for cheap in (True, False):
        for seed in range(plan.seeds):
            for pairs in counts:
                if (pairs <= 300) is cheap:
                    yield from (Job(task, pairs, seed) for task in plan.tasks if pairs in task.counts)


def run(plan: Plan, results: Results, after_job: Callable[[Job, list[Outcome]], None]) -> bool:
    """Add the missing results; return False if the time ran out first."""
    for job in jobs(plan):
        missing = [
            competitor
            for competitor in plan.competitors
            if (job.task.key, competitor.key, job.pairs, job.seed) not in results.outcomes
        ]
        if not missing:
            continue
        if plan.clock() >= plan.deadline_s:
            return False
        trial = job.task.trial(job.seed, job.pairs)
        if trial is None:
            continue
        for test, value in bounds(trial).items():
            results.bounds[job.task.key, job.pairs, job.seed, test] = value
        outcomes = [_outcome(job, competitor, trial, plan, results) for competitor in missing]
        results.outcomes.update({outcome.key: outcome for outcome in outcomes})
        after_job(job, outcomes)
    return True


def _outcome(job: Job, competitor: Competitor, trial: Trial, plan: Plan, results: Results) -> Outcome:
    blank = Outcome(job.task.key, competitor.key, job.pairs, job.seed, "refused")
    reason = competitor.refuses(trial.problem)
    if reason is None and trial.before is not None:
        reason = competitor.refuses(trial.before)
    if reason is not None:
        return replace(blank, reason=reason)
    slow = _slower_size(results, blank)
    if slow is not None:
        return replace(blank, status="too slow", reason=slow)
    try:
        with _time_limit(plan.fit_limit_s), warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore", RuntimeWarning)
            # A separate generator, so that a competitor's random numbers do not depend on those that ran before.
            return _measured(blank, competitor, trial)
    except TooSlow:
        return replace(blank, status="too slow", reason=f"over {plan.fit_limit_s:.0f} s at n = {job.pairs}")
    except (KBMapsError, ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        return replace(blank, status="failed", reason=f"{type(error).__name__}: {error}")


def _slower_size(results: Results, blank: Outcome) -> str | None:
    """Return the reason of an abandoned fit of at most as many pairs, or None."""
    for outcome in results.outcomes.values():
        same = (outcome.task, outcome.competitor) == (blank.task, blank.competitor)
        if same and outcome.status == "too slow" and outcome.pairs <= blank.pairs:
            return outcome.reason
    return None


def _measured(blank: Outcome, competitor: Competitor, trial: Trial) -> Outcome:
    earlier = None if trial.before is None else competitor.learn(_own(trial.before, blank.seed), None)
    begin = time.process_time()
    fitted = competitor.learn(_own(trial.problem, blank.seed), earlier)
    learn_s = time.process_time() - begin
    errors, predict_us = _tested(fitted, trial)
    worst = max(errors.values())
    if not worst < DIVERGED_M:
        return replace(blank, status="failed", reason=f"diverged: mean error {worst:.3g} m")
    return replace(blank, status="ok", errors=errors, learn_s=learn_s, predict_us=predict_us)


def _own(problem: Problem, seed: int) -> Problem:
    return replace(problem, rng=np.random.default_rng([seed, 5]))


def _tested(fitted: Fitted, trial: Trial) -> tuple[dict[str, float], float]:
    """Return the mean error of each test [m], and the best CPU time of a row [µs], once warm."""
    errors: dict[str, float] = {}
    rates: list[float] = []
    for name, (q, x) in trial.tests.items():
        fitted.predict(q)
        begin = time.process_time()
        shown = fitted.predict(q)
        rates.append((time.process_time() - begin) / len(q))
        errors[name] = float(np.linalg.norm(shown - x, axis=1).mean())
    return errors, 1e6 * min(rates)


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raise TooSlow in this thread after `seconds` of CPU time; a call into compiled code is finished first.

    Other processes on the machine do not count.
    """
    if threading.current_thread() is not threading.main_thread():
        raise RuntimeError("fits are limited by a signal, which only the main thread receives")

    def give_up(_signal: int, _frame: object) -> None:
        raise TooSlow

    before = signal.signal(signal.SIGPROF, give_up)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
