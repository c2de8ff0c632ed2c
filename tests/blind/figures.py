"""Rates over many judged cases, with their goals, as Markdown."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.tables import Column, Table

from .dense_judge import runs
from .judge import FEWEST_FALSE_FIXES, TOLD
from .judgement import CauseJudged, Crash, Judgement, TruthJudged, written

BINS = 10
HALF_THE_NOISE = 0.5
GAIN_WANTED = 0.95
SMOOTH_WANTED = 1.3
SECONDS_WANTED, MEGABYTES_WANTED = 3.0, 1024.0
NAMED_WANTED = {"one": 0.99, "outliers": 0.96, "two": 0.97, "three": 0.95, "five": 0.85, "few": 0.85, "scattered": 0.97}
Test = Callable[[Judgement], bool]


@dataclass(frozen=True)
class Rate:
    """Share of cases that pass a test, with its 95 % interval."""

    hits: int
    of: int

    @classmethod
    def over(cls, records: Iterable[Judgement], test: Test) -> Rate:
        """Count the records that pass."""
        passed = [test(record) for record in records]
        return cls(sum(passed), len(passed))

    def __str__(self) -> str:
        if not self.of:
            return "–"
        from scipy.stats import binomtest  # it takes a second to import

        low, high = binomtest(self.hits, self.of).proportion_ci(method="exact")
        return f"{100 * self.hits / self.of:.1f} % ({100 * low:.0f} to {100 * high:.0f}), {self.hits} of {self.of}"


def markdown(records: Sequence[Judgement | Crash]) -> str:
    """Return all tables."""
    crashes = [record for record in records if isinstance(record, Crash)]
    cases = [record for record in records if isinstance(record, Judgement)]
    parts = [goals(cases), confusion(cases), calibration(cases), coverage(cases), failures(cases, crashes)]
    return "\n\n".join(part for part in parts if part)


def goals(cases: Sequence[Judgement]) -> str:
    """Return each figure with its goal."""
    rows = []
    for scenario in dict.fromkeys(case.scenario for case in cases):
        chosen = [case for case in cases if case.scenario == scenario]
        rows += [(scenario, *row) for row in _goals(scenario, chosen)]
    probability = error_of_probability(cases)
    numbers = [n.is_inside for case in cases for cause in case.causes for n in cause.numbers]
    rows.append(
        (
            "all",
            "calibration error of stated probabilities",
            "≤ 0.05",
            "–" if probability is None else f"{probability:.3f}",
        )
    )
    rows.append(("all", "95 % intervals hold the truth", "92 to 98 %", str(Rate(sum(numbers), len(numbers)))))
    return table(("scenario", "what", "goal", "measured (95 % interval)"), rows)


def _goals(scenario: str, cases: Sequence[Judgement]) -> list[tuple[str, str, str]]:
    rows = {"none": _of_nothing, "scattered-none": _of_nothing, "outside": _of_strange}.get(
        scenario, lambda c: _of_named(scenario, c)
    )(cases)
    for what, seconds in (("clock", [c.seconds for c in cases]), ("processor", [c.cpu_seconds for c in cases])):
        typical, most = np.median(seconds), np.quantile(seconds, 0.95)
        rows.append((f"seconds by the {what}: median, 95 %", f"≤ {SECONDS_WANTED:.0f}", f"{typical:.1f}, {most:.1f}"))
    rows.append(("memory [MB]", f"≤ {MEGABYTES_WANTED:.0f}", f"{max(case.memory_mb for case in cases):.0f}"))
    return rows


def _of_nothing(cases: Sequence[Judgement]) -> list[tuple[str, str, str]]:
    return [("`nothing_found`", "≥ 97 %", str(Rate.over(cases, lambda c: c.verdict == "nothing_found")))]


def _of_strange(cases: Sequence[Judgement]) -> list[tuple[str, str, str]]:
    told = [case for case in cases if case.told_chi2 >= TOLD]
    ratios = [case for case in told if case.smooth_ratio is not None]
    return [
        (
            "`unexplained`, right joints",
            "≥ 90 %",
            str(Rate.over(told, lambda c: is_strange(c) and bool(c.joints_right))),
        ),
        ("`unexplained`", "", str(Rate.over(told, is_strange))),
        ("`unexplained`, nothing named for sure", "", str(Rate.over(told, lambda c: c.outcome == "right"))),
        ("below Δχ² 25: named wrongly", "", str(Rate.over([c for c in cases if c.told_chi2 < TOLD], is_wrong))),
        (
            f"error after the smooth model ≤ {SMOOTH_WANTED} × noise",
            "all",
            str(Rate.over(ratios, lambda c: (c.smooth_ratio or 0.0) <= SMOOTH_WANTED)),
        ),
    ]


def _of_named(scenario: str, cases: Sequence[Judgement]) -> list[tuple[str, str, str]]:
    told = [case for case in cases if case.told_chi2 >= TOLD]
    close = [case for case in cases if case.told_chi2 < TOLD]
    large = [case for case in told if case.gain_of_truth and any(t.size >= HALF_THE_NOISE for t in case.truth)]
    wanted = f"≥ {100 * NAMED_WANTED[scenario]:.0f} %"
    listed = [cause for case in cases for cause in case.causes if cause.listed and cause.is_right]
    return [
        ("Δχ² ≥ 25: all named", wanted, str(Rate.over(told, all_named))),
        ("Δχ² ≥ 25: nothing false added", "≥ 97 %", str(Rate.over(told, lambda c: not c.false_causes))),
        ("Δχ² ≥ 25: both, and not `unexplained`", wanted, str(Rate.over(told, lambda c: c.outcome == "right"))),
        ("Δχ² < 25: right or left open", "≥ 95 %", str(Rate.over(close, lambda c: c.outcome in ("right", "honest")))),
        ("Δχ² < 25: named wrongly", "≤ 1 %", str(Rate.over(close, is_wrong))),
        ("whole of the true gain on fresh data (≥ 95 %)", "", str(Rate.over(large, gains_enough))),
        (
            "mean share of the true gain",
            "≥ 95 %",
            f"{100 * np.mean([share_of_gain(c) for c in large]):.2f} %" if large else "–",
        ),
        ("no needless `indistinguishable_from`", "", str(Rate(sum(not c.needless for c in listed), len(listed)))),
        ("right about `any_motion`", "", str(Rate(sum(not c.wrong_reach for c in listed), len(listed)))),
    ]


def all_named(case: Judgement) -> bool:
    """Return True if every hidden effect is named."""
    fixes = any(cause.effect == "outliers" for cause in case.causes)
    return all(t.found_as is not None for t in case.truth) and (fixes or case.false_fixes < FEWEST_FALSE_FIXES)


def is_strange(case: Judgement) -> bool:
    """Return True if the verdict is "unexplained"."""
    return case.verdict == "unexplained"


def is_wrong(case: Judgement) -> bool:
    """Return True if a cause is named wrongly, or an explained case is called unexplained."""
    return case.outcome == "wrong"


def share_of_gain(case: Judgement) -> float:
    """Return the gain on fresh data over that of the ground truth."""
    assert case.gain is not None
    assert case.gain_of_truth is not None
    return case.gain / case.gain_of_truth


def gains_enough(case: Judgement) -> bool:
    """Return True if the diagnosis has nearly all the gain that the true causes give."""
    return share_of_gain(case) >= GAIN_WANTED


def page_table(cases: Sequence[Judgement | Crash]) -> Table:
    """Return the table of docs/results/diagnosis.md; *told*: an oracle distinguishes the causes from any other."""
    commands = []
    by_scenario = {
        name: [case for case in cases if case.scenario == name] for name in (case.scenario for case in cases)
    }
    names_of: dict[tuple[range, ...], list[str]] = defaultdict(list)
    for name, chosen in by_scenario.items():
        names_of[tuple(runs(case.seed for case in chosen))].append(name)
    for seeds, names in names_of.items():
        command = f"python -m tests.blind.sealed --scenario {' '.join(names)}"
        commands += [f"{command} --seeds {len(run)} --first-seed {run[0]}" for run in seeds]
    counts = [Column(name, "", "{} of {}") for name in ("told: right", "all: right")]
    columns = [Column("causes"), *counts, Column("wrong", "", "{}"), Column("goal (told: right)", "%", "{:.0f}")]
    shown = Table("diagnosis_exact", columns, commands)
    for name, chosen in by_scenario.items():
        judged = [case for case in chosen if isinstance(case, Judgement)]
        wrong = len(chosen) - len(judged) + sum(is_wrong(case) for case in judged)
        told = [case for case in judged if case.told_chi2 >= TOLD]
        right = [Rate.over(some, lambda case: case.outcome == "right") for some in (told, judged)]
        shown.add(name, *([rate.hits, rate.of] for rate in right), wrong, 100.0 * NAMED_WANTED.get(name, 0.97))
    return shown


def confusion(cases: Sequence[Judgement]) -> str:
    """Return a confusion table of single hidden effects that an oracle can distinguish."""
    alone = [(case.truth[0], case) for case in cases if len(case.truth) == 1 and case.told_chi2 >= TOLD]
    rows = []
    for effect in sorted({truth.effect for truth, _ in alone}):
        chosen = [(truth, case) for truth, case in alone if truth.effect == effect]
        named = Counter(_named(truth, case) for truth, case in chosen)
        others = ", ".join(
            f"{name} {count}" for name, count in named.most_common() if name not in ("right", "at another joint")
        )
        rows.append((effect, str(len(chosen)), str(named["right"]), str(named["at another joint"]), others))
    return (
        table(("hidden alone, Δχ² ≥ 25", "cases", "right", "at another joint", "named otherwise"), rows) if rows else ""
    )


def _named(truth: TruthJudged, case: Judgement) -> str:
    false = [cause for cause in case.false_causes if cause.effect != "outliers"]
    if truth.found_as is not None:
        return "right" if not false else "right and " + " + ".join(sorted(cause.effect for cause in false))
    if truth.outside and case.verdict == "unexplained":
        return "right" if not false else "unexplained and " + " + ".join(sorted(cause.effect for cause in false))
    if len(false) == 1 and false[0].effect == truth.effect:
        return "at another joint"
    return " + ".join(sorted(cause.effect for cause in false)) or "nothing"


def calibration(cases: Sequence[Judgement]) -> str:
    """Return a table of stated probabilities of causes and the observed share of right ones."""
    rows = []
    for low, chosen in _bins(cases).items():
        stated = np.mean([cause.probability for cause in chosen])
        rows.append(
            (
                f"{low:.1f} to {low + 1 / BINS:.1f}",
                f"{stated:.3f}",
                str(Rate(sum(c.is_right for c in chosen), len(chosen))),
            )
        )
    return table(("stated probability", "mean", "right"), rows) if rows else ""


def error_of_probability(cases: Sequence[Judgement]) -> float | None:
    """Return the expected calibration error over all named causes that are effects."""
    bins = _bins(cases).values()
    total = sum(len(chosen) for chosen in bins)
    if not total:
        return None
    return (
        sum(
            abs(sum(cause.is_right for cause in chosen) - sum(cause.probability for cause in chosen)) for chosen in bins
        )
        / total
    )


def _bins(cases: Sequence[Judgement]) -> dict[float, list[CauseJudged]]:
    bins: dict[float, list[CauseJudged]] = defaultdict(list)
    for case in cases:
        for cause in case.causes:
            if cause.effect != "outliers":
                bins[min(int(cause.probability * BINS), BINS - 1) / BINS].append(cause)
    return dict(sorted(bins.items()))


def coverage(cases: Sequence[Judgement]) -> str:
    """Return a table of the intervals' coverage of each number, with the errors in half widths of the interval."""
    inside: dict[tuple[str, str], list[bool]] = defaultdict(list)
    off: dict[tuple[str, str], list[float]] = defaultdict(list)
    for case in cases:
        for cause in case.causes:
            for number in cause.numbers:
                key = (cause.effect, number.name)
                inside[key].append(number.is_inside)
                half = 0.5 * (number.ci95[1] - number.ci95[0])
                off[key].append(abs(number.value - number.truth) / half if half > 0.0 else float("inf"))
    rows = [
        (effect, name, str(Rate(sum(held), len(held))), f"{np.median(off[effect, name]):.2f}")
        for (effect, name), held in sorted(inside.items())
    ]
    return table(("effect", "number", "interval holds the truth", "median error / half width"), rows) if rows else ""


def failures(cases: Sequence[Judgement], crashes: Sequence[Crash]) -> str:
    """Return a table of the failed cases, with the command to repeat each."""
    rows = []
    for case in cases:
        strange = case.truth[0].outside if case.truth else False
        if case.outcome == "right" and (not strange or case.joints_right):
            continue
        if case.outcome == "honest":
            continue
        hidden = "; ".join(
            f"{written((t.effect, t.where, t.source))} {t.size:.2g}σ Δχ² {t.told_chi2:.0f}"
            f"{' to ' + written(t.rival) if t.rival else ''}{'' if t.found_as or t.outside else ' NOT NAMED'}"
            for t in case.truth
        ) + (f"; {case.false_fixes} false fixes" if case.false_fixes else "")
        false = "; ".join(f"{written((c.effect, c.where, c.source))} p {c.probability:.2f}" for c in case.false_causes)
        depends = f" ({', '.join(case.depends_on)})" if case.verdict == "unexplained" else ""
        rows.append((case.outcome, hidden, false or "–", case.verdict + depends, f"`{case.command}`"))
    rows += [("crashed", "; ".join(c.truth), c.error.strip().splitlines()[-1], "–", f"`{c.command}`") for c in crashes]
    return table(("outcome", "hidden", "false", "verdict", "to look at it again"), rows) if rows else ""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
