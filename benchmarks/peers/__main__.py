"""All learners side by side: `python -m benchmarks.peers [--tasks ...] [--models ...] [--seeds N] [--budget-s S]`.

Results are added to the JSON file as they come, and the next run continues from it; so a long run may be split. A seed
of all tasks with up to 300 pairs takes some four minutes on a busy machine of two cores. The whole page, 50 seeds:

    python -m benchmarks.peers --seeds 50 --data FOLDER --json peers.json --out peers.html
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from pathlib import Path
from typing import TypeVar

from benchmarks.peers.growth import measure
from benchmarks.peers.page import write_page
from benchmarks.peers.recordings import recorded_tasks
from benchmarks.peers.registry import BY_KEY, COMPETITORS
from benchmarks.peers.results import Outcome, Results, machine
from benchmarks.peers.runner import Job, Plan, run
from benchmarks.peers.summary import summary
from benchmarks.peers.tasks import simulated_tasks
from benchmarks.tables import tables_option

DATA_VARIABLE = "BODYSCHEMA_DATA"
_SAVE_EVERY_S = 20.0
_SHARE_FOR_GROWTH = 0.3
_T = TypeVar("_T")


def main() -> None:
    arguments = _parser().parse_args()
    data = arguments.data or (Path(os.environ[DATA_VARIABLE]) if DATA_VARIABLE in os.environ else None)
    tasks = simulated_tasks() + recorded_tasks(data)
    if data is None:
        print(f"recordings: not run, no folder given (--data FOLDER or {DATA_VARIABLE})")
    elif not any(task.title.startswith("Recording") for task in tasks):
        print(f"recordings: not run, no folder with a robot.toml in {data}")
    chosen = _chosen("task", {task.key: task for task in tasks}, arguments.tasks)
    results = Results.load(arguments.json)
    results.forget(set(arguments.again))
    begin = time.monotonic()
    deadline = begin + arguments.budget_s
    plan = Plan(
        chosen,
        _chosen("model", BY_KEY, arguments.models),
        arguments.seeds,
        deadline,
        arguments.fit_limit_s,
        arguments.most_pairs,
        arguments.min_pairs,
    )
    saved = begin

    def after_job(job: Job, outcomes: list[Outcome]) -> None:
        nonlocal saved
        print(_line(job, outcomes), flush=True)
        if time.monotonic() > saved + _SAVE_EVERY_S:
            results.save(arguments.json)
            saved = time.monotonic()

    if arguments.growth:
        stop = begin + _SHARE_FOR_GROWTH * arguments.budget_s
        results.growth = measure(results.growth, lambda: time.monotonic() > stop)
    done = run(plan, results, after_job)
    results.runs.append(
        machine()
        | {
            "when": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
            "seconds": round(time.monotonic() - begin),
            "arguments": f"{arguments.seeds} seeds, {len(chosen)} tasks, "
            f"{arguments.min_pairs} to {arguments.most_pairs} pairs",
        }
    )
    results.save(arguments.json)
    write_page(arguments.out, results, tasks, COMPETITORS)
    for table in summary(results, tasks, plan.competitors):
        table.save(arguments.tables)
    print(f"{'all done' if done else 'the time was up, run again to go on'}: {arguments.out}, {arguments.json}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="*", default=[], help="all by default")
    parser.add_argument("--models", nargs="*", default=[], help=f"all by default: {' '.join(BY_KEY)}")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget-s", type=float, default=float("inf"), help="stop after so many seconds")
    parser.add_argument("--fit-limit-s", type=float, default=30.0, help="give up a fit that takes the processor longer")
    parser.add_argument("--fewest-pairs", type=int, default=0)
    parser.add_argument("--most-pairs", type=int, default=3000)
    parser.add_argument("--again", nargs="*", default=[], metavar="MODEL", help="forget what was measured of these")
    parser.add_argument("--growth", action=argparse.BooleanOptionalAction, default=True, help="time against size")
    parser.add_argument("--data", type=Path, help=f"folder with recordings; else {DATA_VARIABLE}")
    parser.add_argument("--out", type=Path, default=Path("peers.html"))
    tables_option(parser)
    parser.add_argument("--json", type=Path, default=Path("peers.json"))
    return parser


def _chosen(what: str, known: dict[str, _T], names: list[str]) -> list[_T]:
    unknown = [name for name in names if name not in known]
    if unknown:
        sys.exit(f"no {what} {', '.join(unknown)}; there are {', '.join(known)}")
    return [known[name] for name in names] if names else list(known.values())


def _line(job: Job, outcomes: list[Outcome]) -> str:
    good = [outcome for outcome in outcomes if outcome.status == "ok"]
    text = f"{job.task.key:14s} n={job.pairs:5d} seed {job.seed:3d}: "
    if good:
        best = min(good, key=lambda outcome: max(outcome.errors.values()))
        text += f"best {best.competitor} {1e3 * max(best.errors.values()):.2f} mm; "
    failures = [f"{o.competitor} {o.status} ({o.reason})" for o in outcomes if o.status in ("failed", "too slow")]
    return text + (", ".join(failures) or "no failure")


if __name__ == "__main__":
    main()
