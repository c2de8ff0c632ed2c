"""Table of all goals and measured figures: `python -m benchmarks.goals [--rows NAME ...] [--seeds N] [--json FILE]`.

Every seed is saved in the JSON file as soon as it is measured and not measured again. So a long run may be split, and
several may run at once. Seeds begin at 1000, because constants were chosen on lower ones. Unless stated otherwise, a
figure is a rate, or a mean over the seeds with its standard error. Where there is a bound (the posterior error of the
right model with the right prior), the goal is the number or 1.15 times the bound, whichever is larger.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.goals.goal import Row
from benchmarks.goals.registry import rows
from benchmarks.goals.results import Results
from benchmarks.goals.study import NotHereError, Study
from benchmarks.goals.table import overview, table
from benchmarks.peers.__main__ import DATA_VARIABLE
from benchmarks.tables import tables_option

FIRST_SEED = 1000
_SAVE_EVERY_S = 10.0


def main() -> None:
    arguments = _parser().parse_args()
    data = arguments.data or (Path(os.environ[DATA_VARIABLE]) if DATA_VARIABLE in os.environ else None)
    known = {row.name: row for row in rows(data)}
    unknown = [name for name in arguments.rows if name not in known]
    if unknown:
        sys.exit(f"no row {', '.join(unknown)}; there are {', '.join(known)}")
    chosen = [known[name] for name in arguments.rows] or list(known.values())
    results = Results(arguments.json)
    if arguments.again:
        results.forget({study for row in chosen for study in row.studies})
    if not arguments.print:
        measure(chosen, results, arguments.seeds, time.monotonic() + arguments.budget_s)
    shown = table(chosen, results.values())
    for each in (overview(chosen, results.values()), shown):
        each.save(arguments.tables)
    print(shown.markdown())


def measure(chosen: Sequence[Row], results: Results, most_seeds: int | None, deadline: float) -> None:
    """Run the missing studies, row by row, until the deadline on the monotonic clock [s]."""
    for row in chosen:
        for study in row.studies:
            try:
                _run(row, study, results, most_seeds, deadline)
            except NotHereError as error:
                print(f"{row.name}: not run, {error}", file=sys.stderr)
            results.save()


def _run(row: Row, study: Study, results: Results, most_seeds: int | None, deadline: float) -> None:
    saved = begin = time.monotonic()
    wanted = study.seeds if most_seeds is None else min(most_seeds, study.seeds)
    missing = [seed for seed in range(FIRST_SEED, FIRST_SEED + wanted) if (study, seed) not in results]
    for seed in missing:
        if time.monotonic() > deadline:
            return
        results.add(study, seed, study.run(seed))
        if time.monotonic() > saved + _SAVE_EVERY_S:
            results.save()
            saved = time.monotonic()
    if missing:
        took = time.monotonic() - begin
        print(f"{row.name}: {study.key}, {len(missing)} seeds in {took:.0f} s", file=sys.stderr, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.goals", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", nargs="+", default=[], metavar="NAME", help="all by default")
    parser.add_argument("--seeds", type=int, help="no more than so many of a study; as many as are wanted by default")
    parser.add_argument("--json", type=Path, default=Path("goals.json"))
    parser.add_argument("--budget-s", type=float, default=float("inf"), help="begin nothing after so many seconds")
    parser.add_argument("--again", action="store_true", help="forget what was measured of these rows")
    parser.add_argument("--print", action="store_true", help="print the table of what is known, measure nothing")
    tables_option(parser)
    parser.add_argument("--data", type=Path, help=f"folder with recordings; else {DATA_VARIABLE}")
    return parser


if __name__ == "__main__":
    main()
