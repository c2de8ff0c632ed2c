"""`python -m tests.blind.sealed --seeds 100 --scenario one`: hide, diagnose and judge over many seeds.

A seed and a scenario make a case; nothing else goes in. With `--json FILE` a run goes on where the last one ended.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one thread for each process, before numpy is imported

import msgspec
import numpy as np

from benchmarks.tables import tables_option

from .cases import hide
from .figures import markdown, page_table
from .judge import judge
from .judgement import Crash, Judgement, told
from .sizing import NoEffect

GROSS = (3.0, 15.0)
FALSE_FIXES = 0.1
FEW = 200
SCATTERED = (0.2, 1.5)
Record = Judgement | Crash


@dataclass(frozen=True)
class Scenario:
    """A kind of case.

    Attributes:
        effects: as `hide` takes them.
        pairs: of the recording.
        outliers: share of false fixes.
        gross: True if all effects are of gross size.
        scatter: between what the encoders scatter before they round, 1-sigma [ticks]; None for nothing.
    """

    effects: int | str
    pairs: int = 1600
    outliers: float = 0.0
    gross: bool = False
    scatter: tuple[float, float] | None = None

    def size(self, seed: int) -> float | str:
        """Return the size of the effects in units of the noise, or "random"."""
        if not self.gross:
            return "random"
        return float(np.exp(np.random.default_rng([seed, 1]).uniform(*np.log(GROSS))))


SCENARIOS = {
    "one": Scenario(1),
    "two": Scenario(2),
    "three": Scenario(3),
    "five": Scenario(5),
    "none": Scenario(0),
    "outside": Scenario("outside"),
    "outliers": Scenario(1, outliers=FALSE_FIXES),
    "few": Scenario(1, pairs=FEW, gross=True),
    "scattered": Scenario(1, scatter=SCATTERED),
    "scattered-none": Scenario(0, scatter=SCATTERED),
}


@dataclass(frozen=True)
class Case:
    """A scenario and a seed; `pairs` in the place of the scenario's own."""

    scenario: str
    seed: int
    pairs: int | None = None

    @property
    def command(self) -> str:
        """To look at it again."""
        pairs = "" if self.pairs is None else f" --pairs {self.pairs}"
        return f"python -m tests.blind.sealed --scenario {self.scenario} --first-seed {self.seed} --seeds 1{pairs}"


def main() -> None:
    """Run the command."""
    given = _arguments()
    names = list(SCENARIOS) if "all" in given.scenario else given.scenario
    records = read(given.json) if given.json else []
    done = {(record.scenario, record.seed) for record in records}
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    wanted = [Case(name, seed, given.pairs) for seed in seeds for name in names]
    for record in judged([case for case in wanted if (case.scenario, case.seed) not in done], given.processes):
        records.append(record)
        print(told(record), file=sys.stderr, flush=True)
        if given.json:
            with given.json.open("ab") as file:
                file.write(encoded(record) + b"\n")
    chosen = [record for record in records if record.scenario in names]
    if given.show:
        for record in chosen:
            print(msgspec.json.format(encoded(record)).decode())
    print(markdown(chosen) + "\n")
    page_table(chosen).save(given.tables)


def judged(cases: Iterable[Case], processes: int = 1) -> Iterator[Record]:
    """Yield each case as soon as it is judged; cases that cannot be hidden are left out."""
    if processes == 1:
        results = map(run, cases)
        yield from (record for record in results if record is not None)
        return
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for record in pool.imap_unordered(run, cases):
            if record is not None:
                yield record


def run(case: Case) -> Record | None:
    """Run one case; return None if the random effects show nowhere on the random arm."""
    scenario, seed = SCENARIOS[case.scenario], case.seed
    with tempfile.TemporaryDirectory() as folder:
        try:
            hidden = hide(
                seed,
                Path(folder),
                scenario.effects,
                pairs=case.pairs or scenario.pairs,
                size=scenario.size(seed),
                outliers=scenario.outliers,
                scatter=scenario.scatter,
            )
        except NoEffect:
            return None
        try:
            return judge(hidden, case.scenario, case.command)
        except Exception:  # a diagnosis that breaks is a result, too
            truth = tuple(f"{h.effect} {h.where or ''}" for h in hidden.truth)
            return Crash(case.scenario, seed, truth, traceback.format_exc(), case.command)


def encoded(record: Record) -> bytes:
    """Return a record as JSON; numpy scalars become Python numbers."""
    return msgspec.json.encode(record, enc_hook=lambda number: number.item())


def read(file: Path) -> list[Record]:
    """Return the records of earlier runs; an empty list if the file does not exist."""
    if not file.exists():
        return []
    decoder = msgspec.json.Decoder(Record)
    return [decoder.decode(line) for line in file.read_bytes().splitlines() if line.strip()]


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.blind.sealed", description="Judge diagnoses over many seeds."
    )
    parser.add_argument("--seeds", type=int, required=True, help="how many")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--scenario", choices=[*SCENARIOS, "all"], nargs="+", default=["one"])
    parser.add_argument("--pairs", type=int, help="in the place of the scenario's own")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", type=Path, help="one record a line; what is there already is not run again")
    parser.add_argument("--show", action="store_true", help="print the records in full")
    tables_option(parser)
    return parser.parse_args()


if __name__ == "__main__":
    main()
