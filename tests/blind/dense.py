"""`python -m tests.blind.dense --cases 20 --first-seed 0`: judge diagnoses of arms with tolerances at every link.

Each diagnosis runs as a separate command, of any checkout. Print one line a case, and tables at the end.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.tables import tables_option

from .dense_hide import DenseCase, hide_dense, sealed
from .dense_judge import DenseJudgement, inside, line, name, outcome, page_table, placed, rms_mm, table

HERE = Path(__file__).resolve().parent
LIMIT_S = 300.0
DIAGNOSE = "import sys; from bodyschema.cli.main import main; sys.exit(main())"
RUN_FILE = "import runpy, sys; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"


@dataclass(frozen=True)
class Ran:
    """The result of a finished command.

    Attributes:
        code: exit code; negative when killed.
        said: standard output and standard error.
        cpu_seconds, rss_mb: CPU time and peak memory.
    """

    code: int
    said: str
    cpu_seconds: float
    rss_mb: float


@dataclass(frozen=True)
class Checkout:
    """The version of the product under test."""

    folder: Path
    limit_s: float

    @property
    def python(self) -> str:
        """The checkout's own interpreter, else this one."""
        own = self.folder / ".venv" / "bin" / "python"
        return str(own) if own.exists() else sys.executable

    def diagnose(self, case: DenseCase, out: Path, *options: str) -> Ran:
        """Run `bodyschema diagnose`."""
        return self.diagnose_file(case.recording, out, *options)

    def diagnose_file(self, recording: Path, out: Path, *options: str) -> Ran:
        """Run `bodyschema diagnose` on a recording, with the robot.toml beside it."""
        robot = str(recording.with_name("robot.toml"))
        return self._run(DIAGNOSE, "diagnose", str(recording), "--robot", robot, "--out", str(out), *options)

    def positions(self, extended: Path, recording: Path, out: Path) -> Ran:
        """Write the marker positions that the extended simulation predicts."""
        return self._run(RUN_FILE, str(HERE / "dense_positions.py"), str(extended), str(recording), str(out))

    def _run(self, code: str, *arguments: str) -> Ran:
        with tempfile.TemporaryFile() as said:
            child = subprocess.Popen(
                [self.python, "-c", code, *arguments],
                cwd=self.folder,
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
                stdout=said,
                stderr=said,
            )
            timer = threading.Timer(self.limit_s, child.kill)
            timer.start()
            _, status, usage = os.wait4(child.pid, 0)
            timer.cancel()
            child.returncode = os.waitstatus_to_exitcode(status)
            said.seek(0)
            text = said.read().decode(errors="replace")
        return Ran(child.returncode, text, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.blind.dense", description=__doc__)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rows", type=int, help="most rows of a recording")
    parser.add_argument("--causes", type=int, help="how many; drawn when not given")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--checkout", type=Path, default=HERE.parents[1], help="whose diagnosis is judged")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="seconds for each diagnosis")
    parser.add_argument("--json", type=Path, help="one record a line; what is there already is not run again")
    parser.add_argument("--keep", type=Path, help="folder in which cases and diagnoses stay")
    tables_option(parser)
    given = parser.parse_args()
    records = _read(given.json)
    done = {record.seed for record in records}
    checkout = Checkout(given.checkout.resolve(), given.limit)
    seeds = [seed for seed in range(given.first_seed, given.first_seed + given.cases) if seed not in done]

    def one(seed: int) -> DenseJudgement:
        if given.keep is not None:
            return run(seed, given.keep.resolve() / str(seed), checkout, given.rows, given.causes)
        with tempfile.TemporaryDirectory() as folder:
            return run(seed, Path(folder), checkout, given.rows, given.causes)

    with ThreadPoolExecutor(given.jobs) as pool:
        for record in pool.map(one, seeds):
            records.append(record)
            print(line(record), flush=True)
            if given.json is not None:
                with given.json.open("ab") as file:
                    file.write(msgspec.json.encode(record) + b"\n")
    print("\n" + table(records) + "\n")
    page_table(records).save(given.tables)


def run(
    seed: int, folder: Path, checkout: Checkout, rows: int | None = None, causes: int | None = None
) -> DenseJudgement:
    """Hide, diagnose and judge one case."""
    case = hide_dense(seed, folder, rows=rows, count=causes)
    out = folder / "out"
    ran, refused = checkout.diagnose(case, out), ""
    if ran.code > 0 and "Traceback" not in ran.said:
        refused, ran = ran.said.strip(), checkout.diagnose(case, out, "--force")
    truth, told = sealed(case), _told(out, ran)
    what, false, missed = outcome(truth, told) if told else ("crashed", [], [])
    extended = _extended_mm(case, out, checkout) if told else None
    floor = told["rms_mm"]["noise_floor"] if told else None
    return DenseJudgement(
        seed=seed,
        rows=len(case.measured.q),
        joints=len(case.arm.read),
        style=case.style,
        noise=case.noise.kind,
        decidable=case.is_decidable,
        truth=tuple(entry["cause"] for entry in truth["truth"]),
        nats=case.nats,
        outcome=what,
        verdict=told["verdict"] if told else "none",
        named=tuple(
            f"{name(c)} {c['probability']:.2f}/{c['share_of_gain_percent']:.0f}%" for c in told.get("causes", ())
        ),
        false=tuple(false),
        missed=tuple(missed),
        inside=inside(truth, told) if told else (0, 0),
        placed_mm=_placed_mm(case),
        extended_mm=extended,
        floor_ratio=None if floor is None else floor / _noise_mm(case),
        tolerances=truth["tolerances"],
        stated_tolerances=told.get("tolerances"),
        cpu_seconds=ran.cpu_seconds,
        rss_mb=ran.rss_mb,
        refused=refused,
        error="" if told else ran.said[-2000:] or f"killed after {checkout.limit_s:.0f} s",
    )


def _told(out: Path, ran: Ran) -> dict[str, Any]:
    """Return the contents of diagnosis.json; {} without one."""
    file = out / "diagnosis.json"
    return json.loads(file.read_text(encoding="utf-8")) if ran.code == 0 and file.exists() else {}


def _noise_mm(case: DenseCase) -> float:
    """Return the RMS of the noise, with encoder quantisation and without false fixes."""
    added = rms_mm((case.measured.x - case.measured.x_true)[~case.measured.false])
    return math.hypot(added, 1e3 * math.sqrt(3.0) * case.rounding_m)


def _placed_mm(case: DenseCase) -> float:
    """Return the RMS error on other poses of the nominal model, unknown instrument and marker fitted."""
    known = {"pose_known": case.pose_known, "marker_known": case.marker_known}
    built = placed(case.nominal, case.measured.q, case.measured.x, **known)
    return rms_mm(built.measured(case.fresh.q) - case.fresh.x_true)


def _extended_mm(case: DenseCase, out: Path, checkout: Checkout) -> float | None:
    """Return the RMS error on other poses of extended.toml; None if it cannot be loaded."""
    file = out / "fresh.npy"
    ran = checkout.positions(out / "extended.toml", case.folder / "fresh.csv", file)
    return rms_mm(np.load(file) - case.fresh.x_true) if ran.code == 0 else None


def _read(file: Path | None) -> list[DenseJudgement]:
    if file is None or not file.exists():
        return []
    return [msgspec.json.decode(text, type=DenseJudgement) for text in file.read_bytes().splitlines()]


if __name__ == "__main__":
    main()
