"""Judge a diagnosis of an arm with tolerances at every link.

Only diagnosis.json is read, so any version of the diagnosis can be judged.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.tables import Column, Table

from .arrays import FloatArray
from .dense_chain import Built, Posture

Outcome = Literal["right", "honest", "vague", "wrong", "crashed"]
OUTCOMES: tuple[Outcome, ...] = ("right", "honest", "vague", "wrong", "crashed")
LARGE_SHARE = 15.0  # percent of the gain, from which a false cause counts
SURE = 0.9
GOALS = {0: 97, 1: 97, 2: 95, 3: 93, 5: 80}  # percent right, by the number of causes
NUMERALS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight")
OUTCOME_COLUMNS = [Column(name, "", "{}") for name in ("right", "honest", "vague", "wrong")]
NO_WORSE = 1.02  # times the error of the placed nominal model
ROUNDED_MM = 1e-6
ROUNDS = 30
Json = Mapping[str, Any]


class DenseJudgement(msgspec.Struct, frozen=True):
    """One case.

    Attributes:
        outcome: right: every hidden cause is named and no significant false one. honest: each cause not named is
            listed as an alternative, or its joint as one on which the unexplained error depends. wrong: a false cause
            is named as certain, without a true alternative. vague: the rest.
        named: causes with their probabilities; false, missed: significant ones not there, and those not named.
        inside: number of named hidden joint offsets and backlashes whose intervals contain the truth, and number of
            them.
        placed_mm, extended_mm: RMS error on other poses of the nominal model with the unknown parameters fitted, and
            of extended.toml.
        floor_ratio: stated noise floor over the RMS of the true noise.
        tolerances, stated_tolerances: 1 sigma, true and stated.
        refused: message of the command that needed --force.
    """

    seed: int
    rows: int
    joints: int
    style: str
    noise: str
    decidable: bool
    truth: tuple[str, ...]
    nats: tuple[float, ...]
    outcome: Outcome
    verdict: str
    named: tuple[str, ...]
    false: tuple[str, ...]
    missed: tuple[str, ...]
    inside: tuple[int, int]
    placed_mm: float
    extended_mm: float | None
    floor_ratio: float | None
    tolerances: dict[str, float]
    stated_tolerances: dict[str, Any] | None
    cpu_seconds: float
    rss_mb: float
    refused: str = ""
    error: str = ""

    @property
    def no_worse(self) -> bool | None:
        """True if extended.toml predicts other poses at least as well as the placed nominal model."""
        return None if self.extended_mm is None else self.extended_mm <= NO_WORSE * self.placed_mm + ROUNDED_MM


def name(entry: Json) -> str:
    """Return an entry of diagnosis.json as `effect@where:source`."""
    where, source = entry.get("where"), entry.get("source")
    return entry["effect"] + (f"@{where}" if where else "") + (f":{source}" if source else "")


def outcome(sealed: Json, told: Json) -> tuple[Outcome, list[str], list[str]]:
    """Return the outcome, the false causes with a large share, and the missed causes."""
    truth = {entry["cause"]: entry["same"] for entry in sealed["truth"]}
    causes = [cause for cause in told["causes"] if not _is_false_fixes(sealed, cause)]
    found = _found(truth, [name(cause) for cause in causes])
    missed = [cause for cause in truth if cause not in found]
    weights = shares_of_causes(causes)
    false = [c for c, w in zip(causes, weights, strict=True) if name(c) not in found.values() and w >= LARGE_SHARE]
    names = [name(cause) for cause in false]
    if not missed and not false:
        return "right", names, missed
    true_names = {*truth, *(other for same in truth.values() for other in same)}
    if any(cause["probability"] > SURE and not true_names & _alternatives(cause) for cause in false):
        return "wrong", names, missed
    is_open = told["verdict"] in ("undecided", "unexplained")
    told_too = {other for cause in causes for other in _alternatives(cause)}
    shown = set(told["unexplained"]["depends_on"]) if is_open else set()
    left_open = all({hidden, *truth[hidden]} & told_too or _place(hidden) in shown for hidden in missed)
    return ("honest" if left_open and (missed or is_open) else "vague"), names, missed


def shares_of_causes(causes: Sequence[Json]) -> list[float]:
    """Return the share [%] of each cause in the gain of all named ones, whatever tolerances explain beside them."""
    total = sum(cause["share_of_gain_percent"] for cause in causes) or 100.0
    return [100.0 * cause["share_of_gain_percent"] / total for cause in causes]


def _found(truth: Mapping[str, Sequence[str]], named: Sequence[str]) -> dict[str, str]:
    """Return the name under which each hidden cause was found: its own, or an equivalent one."""
    found = {hidden: hidden for hidden in truth if hidden in named}
    for hidden, same in truth.items():
        free = [other for other in same if other in named and other not in found.values()]
        if hidden not in found and free:
            found[hidden] = free[0]
    return found


def _alternatives(cause: Json) -> set[str]:
    """Return the alternatives that are stated for a cause."""
    return {name(other) for key in ("rivals", "indistinguishable_from") for other in cause.get(key, ())}


def _place(hidden: str) -> str:
    """Return the joint of a cause; `time` for one that has no joint."""
    return hidden.partition("@")[2].partition(":")[0] or "time"


def _is_false_fixes(sealed: Json, cause: Json) -> bool:
    """Return True for `outliers` where some fixes are false or the noise has heavy tails."""
    return cause["effect"] == "outliers" and sealed["noise"]["kind"] in ("outliers", "student")


def inside(sealed: Json, told: Json) -> tuple[int, int]:
    """Count the intervals of joint offsets and backlashes that contain the truth, and all of them."""
    hits = []
    for entry in sealed["truth"]:
        effect = entry["cause"].partition("@")[0]
        for cause in told["causes"]:
            if name(cause) == entry["cause"] and effect in _NUMBERS:
                begins, sign = _NUMBERS[effect]
                low, high = next(v["ci95"] for k, v in cause["parameters"].items() if k.startswith(begins))
                hits.append(low <= sign * entry["amounts"][0] <= high)
    return sum(hits), len(hits)


# Beginning of the parameter's name, and the sign with which the hidden amount is counted there.
_NUMBERS: dict[str, tuple[str, float]] = {"joint_offset": ("offset_", -1.0), "backlash": ("width_", 1.0)}


def placed(nominal: Built, q: FloatArray, x: FloatArray, *, pose_known: bool, marker_known: bool) -> Built:
    """Return the nominal arm with the unknown parameters of camera and marker fitted to x (n, 3) [m] at q (n, d)."""
    built = nominal
    if not pose_known:
        built = _turned(built, q, x)
    if pose_known and marker_known:
        return built
    for _ in range(ROUNDS):
        posture = Posture.of(built, q)
        blocks = [] if pose_known else [posture.by_eye()]
        blocks += [] if marker_known else [posture.by_marker()]
        J, left = np.concatenate(blocks, axis=2), x - posture.seen()
        far = np.linalg.norm(left, axis=1)
        weight = 1.0 / np.maximum(far, 2.0 * np.median(far) + 1e-12)  # of false fixes only their direction counts
        weighted = J * weight[:, None, None]
        step = np.linalg.lstsq(weighted.reshape(-1, J.shape[2]), (left * weight[:, None]).ravel(), rcond=1e-12)[0]
        if not pose_known:
            built = _moved(built, step[:6])
        if not marker_known:
            built = _shifted(built, step[-3:])
        if np.abs(step).max() < 1e-10:
            break
    return built


def _turned(built: Built, q: FloatArray, x: FloatArray) -> Built:
    """Align the instrument by the best rigid motion of all positions."""
    seen = Posture.of(built, q).seen()
    middle, there = np.median(seen, axis=0), np.median(x, axis=0)
    U, _, Vt = np.linalg.svd((seen - middle).T @ (x - there))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    back = U @ flip @ Vt  # from the measured frame to the one that is described
    return replace(built, eye_R=built.eye_R @ back, eye_x=built.eye_x + built.eye_R @ (middle - back @ there))


def _moved(built: Built, step: FloatArray) -> Built:
    turn = Rotation.from_rotvec(step[3:]).as_matrix()
    return replace(built, eye_R=built.eye_R @ turn, eye_x=built.eye_x + built.eye_R @ step[:3])


def _shifted(built: Built, step: FloatArray) -> Built:
    return replace(built, marker=built.marker + step)


def rms_mm(off: FloatArray) -> float:
    """Return the RMS of distances (n, 3) [m] in millimetres."""
    return float(1e3 * np.sqrt(np.square(off).sum(axis=1).mean()))


def line(record: DenseJudgement) -> str:
    """Return a record as one line of text."""
    there = ", ".join(f"{t} ({n:.0f})" for t, n in zip(record.truth, record.nats, strict=True)) or "nothing"
    named = ", ".join(record.named) or "nothing"
    hard = "" if record.decidable else " (not decidable)"
    error = "–" if record.extended_mm is None else f"{record.extended_mm:.2f}"
    last = f" {record.error.strip().splitlines()[-1]}" if record.error.strip() else ""
    return (
        f"{record.seed} {record.outcome}{hard}: {there} -> {named} [{record.verdict}] {record.rows} rows, "
        f"{record.placed_mm:.2f} -> {error} mm, {record.cpu_seconds:.1f} s{last}"
    )


def table(records: Sequence[DenseJudgement]) -> str:
    """Return all figures as Markdown."""
    groups = {
        **{f"{count} causes": [r for r in records if r.decidable and len(r.truth) == count] for count in range(9)},
        "several zeros": [r for r in records if r.decidable and _zeros(r) > 1],
        "all decidable": [r for r in records if r.decidable],
        "not decidable": [r for r in records if not r.decidable],
    }
    rows = [["cases", "of", *OUTCOMES]]
    for group, chosen in groups.items():
        if chosen:
            rows.append([group, str(len(chosen)), *(str(sum(r.outcome == o for r in chosen)) for o in OUTCOMES)])
    rows.insert(1, ["---"] * len(rows[0]))
    return "\n".join(["| " + " | ".join(row) + " |" for row in rows] + ["", *_figures(records)])


def page_table(records: Sequence[DenseJudgement]) -> Table:
    """Return the table of docs/results/diagnosis.md; a crash counts as wrong."""
    seeds = runs(record.seed for record in records)
    commands = [f"python -m tests.blind.dense --cases {len(run)} --first-seed {run[0]}" for run in seeds]
    columns = [Column("causes hidden"), Column("cases", "", "{}"), *OUTCOME_COLUMNS, Column("goal (right)", "%", "{}")]
    shown = Table("diagnosis_tolerances", columns, commands)
    for count, numeral in enumerate(NUMERALS):
        chosen = [record for record in records if record.decidable and len(record.truth) == count]
        if chosen:
            shown.add(numeral, len(chosen), *outcomes([record.outcome for record in chosen]), GOALS.get(count))
    hard = [record.outcome for record in records if not record.decidable]
    if hard:
        shown.add("cannot be decided", len(hard), *outcomes(hard), None)
    shown.add("all", len(records), *outcomes([record.outcome for record in records]), None)
    return shown


def outcomes(found: Sequence[Outcome]) -> list[int]:
    """Return how many are right, honest, vague, and wrong or crashed."""
    return [found.count("right"), found.count("honest"), found.count("vague"), sum(o in OUTCOMES[3:] for o in found)]


def runs(seeds: Iterable[int]) -> list[range]:
    """Return the runs of consecutive numbers in some."""
    found: list[range] = []
    for seed in sorted(set(seeds)):
        if found and found[-1].stop == seed:
            found[-1] = range(found[-1].start, seed + 1)
        else:
            found.append(range(seed, seed + 1))
    return found


def _figures(records: Sequence[DenseJudgement]) -> list[str]:
    scored = [r for r in records if r.no_worse is not None]
    ratios = [r.extended_mm / r.placed_mm for r in scored if r.extended_mm is not None]
    floors = [r.floor_ratio for r in records if r.floor_ratio is not None]
    hits, numbers = (sum(r.inside[k] for r in records) for k in (0, 1))
    return [
        f"- other poses: no worse than the placed nominal model {sum(map(_no_worse, scored))} of {len(scored)}; "
        f"error over its error {_spread(ratios)}",
        f"- stated noise floor over true noise: {_spread(floors)}",
        f"- intervals of zeros and plays hold the truth: {hits} of {numbers}",
        f"- seconds of the processor: {_spread([r.cpu_seconds for r in records])}; "
        f"memory at most {max((r.rss_mb for r in records), default=0.0):.0f} MB",
        f"- refused without --force: {sum(bool(r.refused) for r in records)} of {len(records)}",
    ]


def _spread(values: Iterable[float]) -> str:
    """Return median and range."""
    found = sorted(values)
    return f"median {np.median(found):.2f} ({found[0]:.2f} to {found[-1]:.2f})" if found else "–"


def _no_worse(record: DenseJudgement) -> bool:
    return bool(record.no_worse)


def _zeros(record: DenseJudgement) -> int:
    return sum(cause.startswith("joint_offset") for cause in record.truth)
