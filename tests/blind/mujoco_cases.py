"""`python -m tests.blind.mujoco_cases --cases 21 --first-seed 0`: judge diagnoses of arms simulated by MuJoCo.

Each seed is an arm with a hidden cause, and two cases: a walk and static poses. Print one line a case, and tables at
the end. `--models` takes other arms: URDFs, folders of them, or modules of the package robot_descriptions, which
downloads them when they are imported (`--models ur10_description gen3_description folder/`). Of each, the longest chain
of turning joints is taken. The arm of a seed depends on which are given, and in which order.
"""

from __future__ import annotations

import argparse
import importlib
import json
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.tables import Column, Table, tables_option

from .arrays import FloatArray
from .dense import HERE, LIMIT_S, Checkout, Ran
from .dense_judge import (
    LARGE_SHARE,
    NO_WORSE,
    OUTCOME_COLUMNS,
    OUTCOMES,
    ROUNDED_MM,
    SURE,
    Outcome,
    name,
    outcomes,
    rms_mm,
    runs,
    shares_of_causes,
)
from .mujoco_hide import KINDS, STYLES, Case, Style, Truth, hide
from .mujoco_urdf import MODELS, Model, longest_arm

# Cycles a turn by which a strain wave may be missed.
SAME_CYCLES = 1.5
OF_TOLERANCES = ("outliers",)


class Judgement(msgspec.Struct, frozen=True):
    """One case.

    Attributes:
        outcome: right, honest, vague, wrong or crashed.
        truth: hidden causes in words; names: names that count as right.
        named: causes with their probabilities and shares of the gain; false: significant ones that are not there.
        not_worth: causes whose gain on held-out blocks is not positive.
        placed_mm, extended_mm: RMS error on a later recording of the nominal model with the unknown parameters
            fitted, and of extended.toml.
        floor_ratio: stated noise floor over true noise.
    """

    seed: int
    style: str
    kind: str
    model: str
    rows: int
    dense: float
    noise_mm: float
    truth: tuple[str, ...]
    names: tuple[str, ...]
    outcome: Outcome
    verdict: str
    named: tuple[str, ...]
    false: tuple[str, ...]
    not_worth: tuple[str, ...]
    depends_on: tuple[str, ...]
    gain_percent: float | None
    placed_mm: float
    extended_mm: float | None
    floor_ratio: float | None
    cpu_seconds: float
    error: str = ""

    @property
    def no_worse(self) -> bool | None:
        """True if extended.toml predicts a later recording at least as well as the placed nominal model."""
        return None if self.extended_mm is None else self.extended_mm <= NO_WORSE * self.placed_mm + ROUNDED_MM


def outcome(truth: Sequence[Truth], also: Sequence[str], told: dict[str, Any]) -> tuple[Outcome, list[str]]:
    """Return the outcome and the false causes with a large share.

    right: every hidden cause is named, or unexplained on its joints if it has no name, and no false one is named.
    honest: a cause not named is an alternative of a named one, or unexplained on the right joints.
    wrong: a false cause is named as certain, without a true one. vague: the rest.
    """
    causes = [cause for cause in told["causes"] if cause["effect"] not in OF_TOLERANCES]
    hidden = {other: one for one in truth for other in (one.name, *one.same) if other}
    true = [cause for cause in causes if name(cause) in hidden and _same_wave(hidden[name(cause)], cause)]
    found = {hidden[name(cause)].name for cause in true}
    weights = shares_of_causes(told["causes"])
    large = [cause for cause, w in zip(told["causes"], weights, strict=True) if w >= LARGE_SHARE and cause in causes]
    false = [cause for cause in large if cause not in true and name(cause) not in also]
    names = [name(cause) for cause in false]
    depends_on = set(told["unexplained"]["depends_on"]) if told["verdict"] in ("undecided", "unexplained") else set()
    missed = [one for one in truth if one.name not in found]
    nameless_shown = all(not one.name and depends_on & set(one.joints) for one in missed)
    if not false and nameless_shown:
        return "right", names
    if any(cause["probability"] > SURE and not set(hidden) & _alternatives(cause) for cause in false):
        return "wrong", names
    alternatives = {other for cause in causes for other in _alternatives(cause)}
    left_open = all({one.name, *one.same} & alternatives or _places(one) & depends_on for one in missed)
    is_open = told["verdict"] in ("undecided", "unexplained")
    return ("honest" if left_open and (missed or is_open) else "vague"), names


def _same_wave(hidden: Truth, cause: dict[str, Any]) -> bool:
    if hidden.cycles is None:
        return True
    return abs(cause["parameters"]["cycles_per_turn"]["value"] - hidden.cycles) <= SAME_CYCLES


def _alternatives(cause: dict[str, Any]) -> set[str]:
    return {name(other) for key in ("rivals", "indistinguishable_from") for other in cause[key]}


def _places(hidden: Truth) -> set[str]:
    return {*hidden.joints, hidden.name.partition("@")[2]}


def models_of(source: str) -> list[Model]:
    """Return the arms of a folder of URDFs, of one URDF, or of a module of the package robot_descriptions."""
    path = Path(source)
    if not path.exists():
        path = Path(importlib.import_module(f"robot_descriptions.{source}").URDF_PATH)
    files = sorted(path.rglob("*.urdf")) if path.is_dir() else [path]
    return [longest_arm(file.resolve()) for file in files]


def run(
    seed: int,
    style: Style,
    folder: Path,
    checkout: Checkout,
    rows: int | None = None,
    kind: str | None = None,
    models: Sequence[Model] = MODELS,
) -> Judgement:
    """Hide, diagnose and judge one case."""
    return judged(hide(seed, style, folder, rows=rows, kind=kind, models=models), checkout)


def judged(case: Case, checkout: Checkout) -> Judgement:
    """Diagnose and judge a case."""
    out = case.folder / "out"
    ran = diagnosed(case, out, checkout)
    told = _told(out, ran)
    what, false = outcome(case.truth, case.also, told) if told else ("crashed", [])
    floor = told["rms_mm"]["noise_floor"] if told else None
    noise_mm = rms_mm(case.taken.x - case.taken.x_true)
    return Judgement(
        seed=case.seed,
        style=case.style,
        kind=case.kind,
        model=case.model,
        rows=len(case.taken.q),
        dense=case.dense,
        noise_mm=noise_mm,
        truth=tuple(one.says for one in case.truth),
        names=tuple(one.name or "unexplained" for one in case.truth),
        outcome=what,
        verdict=told["verdict"] if told else "none",
        named=tuple(
            f"{name(c)} {c['probability']:.2f}/{c['share_of_gain_percent']:.0f}%" for c in told.get("causes", ())
        ),
        false=tuple(false),
        not_worth=tuple(name(c) for c in told.get("causes", ()) if c["held_out_gain_percent"] <= 0.0),
        depends_on=tuple(told["unexplained"]["depends_on"]) if told else (),
        gain_percent=told["gain"]["held_out_percent"] if told else None,
        placed_mm=placed_mm(case),
        extended_mm=_extended_mm(case, out, checkout) if told else None,
        floor_ratio=None if floor is None else floor / noise_mm,
        cpu_seconds=ran.cpu_seconds,
        error="" if told else ran.said[-1500:] or f"killed after {checkout.limit_s:.0f} s",
    )


def diagnosed(case: Case, out: Path, checkout: Checkout) -> Ran:
    """Run `bodyschema diagnose`, once more with --force where it refuses."""
    recording = case.folder / "recording.csv"
    ran = checkout.diagnose_file(recording, out)
    if ran.code > 0 and "Traceback" not in ran.said:
        return checkout.diagnose_file(recording, out, "--force")
    return ran


def placed_mm(case: Case) -> float:
    """Return the RMS error on the later recording of the nominal arm, unknown camera pose and marker fitted."""
    (before, later), (R, place) = case.nominal, case.camera

    def seen(poses: tuple[FloatArray, FloatArray], numbers: FloatArray) -> FloatArray:
        marker = case.marker + (0.0 if case.marker_known else numbers[6:])
        x = (poses[0] + poses[1] @ marker - place) @ R
        return x if case.pose_known else Rotation.from_rotvec(numbers[3:6]).apply(x) + numbers[:3]

    fitted = least_squares(lambda numbers: 1e3 * (seen(before, numbers) - case.taken.x).ravel(), np.zeros(9)).x
    return rms_mm(seen(later, fitted) - case.fresh.x_true)


def _extended_mm(case: Case, out: Path, checkout: Checkout) -> float | None:
    file = out / "fresh.npy"
    ran = checkout.positions(out / "extended.toml", case.folder / "fresh.csv", file)
    return rms_mm(np.load(file) - case.fresh.x_true) if ran.code == 0 else None


def _told(out: Path, ran: Ran) -> dict[str, Any]:
    file = out / "diagnosis.json"
    return json.loads(file.read_text(encoding="utf-8")) if ran.code == 0 and file.exists() else {}


def line(record: Judgement) -> str:
    """Return a record in a line."""
    extended = "–" if record.extended_mm is None else f"{record.extended_mm:.2f}"
    depends = f" on {', '.join(record.depends_on)}" if record.depends_on else ""
    last = f" {record.error.strip().splitlines()[-1]}" if record.error.strip() else ""
    floor = "–" if record.floor_ratio is None else f"{record.floor_ratio:.2f}"
    return (
        f"{record.seed} {record.style} {record.kind} {record.model} {record.outcome}: "
        f"{'; '.join(record.truth) or 'nothing'} -> {', '.join(record.named) or 'nothing'} [{record.verdict}{depends}] "
        f"{record.rows} rows, tolerances x{record.dense:.1f}, {record.placed_mm:.2f} -> {extended} mm, "
        f"floor {floor}, {record.cpu_seconds:.1f} s{last}"
    )


def table(records: Sequence[Judgement]) -> str:
    """Return all figures as Markdown."""
    groups = {kind: [r for r in records if r.kind == kind] for kind in KINDS}
    groups |= {style: [r for r in records if r.style == style] for style in STYLES}
    groups |= {
        "tolerances": [r for r in records if r.dense],
        "no tolerances": [r for r in records if not r.dense],
        "all": list(records),
    }
    rows = [["cases", "of", *OUTCOMES], ["---"] * (2 + len(OUTCOMES))]
    rows += [
        [group, str(len(chosen)), *(str(sum(r.outcome == o for r in chosen)) for o in OUTCOMES)]
        for group, chosen in groups.items()
        if chosen
    ]
    scored = [r for r in records if r.no_worse is not None]
    floors = np.array([r.floor_ratio for r in records if r.floor_ratio is not None])
    seconds = [r.cpu_seconds for r in records]
    worse = [f"{r.seed} {r.style} {r.placed_mm:.2f} -> {r.extended_mm:.2f}" for r in scored if not r.no_worse]
    return "\n".join(
        [
            *("| " + " | ".join(row) + " |" for row in rows),
            "",
            f"- later recording: extended.toml worse than the placed nominal model {len(worse)} of {len(scored)}: "
            f"{', '.join(worse) or 'none'}",
            f"- noise floor over true noise: median {np.median(floors):.2f}, 0.8 to 1.25 in "
            f"{int(((floors >= 0.8) & (floors <= 1.25)).sum())} of {len(floors)}"
            if len(floors)
            else "",
            f"- seconds of the processor: median {np.median(seconds):.1f}, 95 % {np.quantile(seconds, 0.95):.1f}",
            f"- cases with a cause of no held-out gain: {sum(bool(r.not_worth) for r in records)} of {len(records)}",
        ]
    )


def page_table(records: Sequence[Judgement]) -> Table:
    """Return the table of docs/results/diagnosis.md; a crash counts as wrong."""
    seeds = runs(record.seed for record in records)
    commands = [f"python -m tests.blind.mujoco_cases --cases {len(run)} --first-seed {run[0]}" for run in seeds]
    shown = Table("diagnosis_mujoco", [Column("arms"), Column("recordings", "", "{}"), *OUTCOME_COLUMNS], commands)
    shown.add(", ".join(sorted({r.model for r in records})), len(records), *outcomes([r.outcome for r in records]))
    return shown


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.blind.mujoco_cases", description=__doc__)
    parser.add_argument("--cases", type=int, default=len(KINDS), help="seeds, two cases each")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rows", type=int, help="of each recording")
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), default=list(KINDS), help="kinds of causes, in turn")
    parser.add_argument("--models", nargs="*", help="other arms; see above")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--checkout", type=Path, default=HERE.parents[1], help="whose diagnosis is judged")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="seconds for each diagnosis")
    parser.add_argument("--json", type=Path, help="one record a line; cases in it are not run again")
    parser.add_argument("--keep", type=Path, help="folder in which cases and diagnoses stay")
    tables_option(parser)
    given = parser.parse_args()
    records = _read(given.json)
    done = {(record.seed, record.style) for record in records}
    checkout = Checkout(given.checkout.resolve(), given.limit)
    models = [model for source in given.models for model in models_of(source)] if given.models else MODELS
    cases = [
        (seed, style)
        for seed in range(given.first_seed, given.first_seed + given.cases)
        for style in STYLES
        if (seed, style) not in done
    ]

    def one(case: tuple[int, Style]) -> Judgement:
        seed, style = case
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) if given.keep is None else given.keep.resolve() / f"{seed}_{style}"
            return run(seed, style, folder, checkout, given.rows, given.kinds[seed % len(given.kinds)], models)

    with ThreadPoolExecutor(given.jobs) as pool:
        for record in pool.map(one, cases):
            records.append(record)
            print(line(record), flush=True)
            if given.json is not None:
                with given.json.open("ab") as file:
                    file.write(msgspec.json.encode(record) + b"\n")
    print("\n" + table(records) + "\n")
    page_table(records).save(given.tables)


def _read(file: Path | None) -> list[Judgement]:
    if file is None or not file.exists():
        return []
    return [msgspec.json.decode(text, type=Judgement) for text in file.read_bytes().splitlines()]


if __name__ == "__main__":
    main()
