"""Judgement of one case, in the form in which it is stored."""

from __future__ import annotations

from typing import Literal

import msgspec

Outcome = Literal["right", "honest", "missed", "wrong"]
Key = tuple[str, str | None, str | None]


class Number(msgspec.Struct, frozen=True):
    """A number that was found, with the true one."""

    name: str
    truth: float
    value: float
    ci95: tuple[float, float]

    @property
    def is_inside(self) -> bool:
        """True if the interval contains the true value."""
        return self.ci95[0] <= self.truth <= self.ci95[1]


class TruthJudged(msgspec.Struct, frozen=True):
    """One hidden effect.

    Attributes:
        effect, where, source: in the table's words.
        size: in units of the noise.
        outside: True if no row of the table describes it.
        seen_chi2: rise of an oracle's chi-square without it.
        told_chi2: rise of an oracle's chi-square with its best alternative in its place.
        rival: that alternative.
        found_as: the cause that names it, or None.
        among_rivals: True if a wrong cause lists it as an alternative.
    """

    effect: str
    where: str | None
    source: str | None
    size: float
    outside: bool
    seen_chi2: float
    told_chi2: float
    rival: Key | None
    found_as: Key | None
    among_rivals: bool


class CauseJudged(msgspec.Struct, frozen=True):
    """One named cause.

    Attributes:
        is_right: True if it is a hidden effect, or the simplest name of one.
        open: True if its alternatives contain a hidden effect and it is not stated as certain.
        listed: number of effects reported as indistinguishable from it.
        needless: those of them that this motion does distinguish.
        wrong_reach: those of them with a wrong statement on whether another motion would distinguish them.
        numbers: parameters of a right cause in a right diagnosis.
        left_out: numbers that were not judged, with the reasons.
    """

    effect: str
    where: str | None
    source: str | None
    probability: float
    is_right: bool
    open: bool
    listed: int
    needless: tuple[str, ...]
    wrong_reach: tuple[str, ...]
    numbers: tuple[Number, ...]
    left_out: dict[str, str]


class Judgement(msgspec.Struct, frozen=True, tag="judged"):
    """One case.

    Attributes:
        outcome: right: all causes and no other. honest: causes that are not right are left open. missed: a cause is
            not named though an oracle sees it. wrong: a false cause is named, or an explained case left unexplained.
        gain: reduction (0..1) of the extended simulation's error on a fresh recording, relative to the aligned
            nominal model, against positions free of noise; None if nothing is hidden.
        gain_of_truth: the same with the true effects.
        depends_on, shows_on: reported and true joints of an effect outside the table.
        joints_right: True if these agree.
        smooth_ratio: held-out error after the smooth model over the noise floor.
        seconds, cpu_seconds: wall time and CPU time of the diagnosis.
        command: command that repeats the case.
        false_fixes: number of fixes that are not the marker.
    """

    scenario: str
    seed: int
    arm: str
    hold: str
    style: str
    pairs: int
    verdict: str
    outcome: Outcome
    truth: tuple[TruthJudged, ...]
    causes: tuple[CauseJudged, ...]
    gain: float | None
    gain_of_truth: float | None
    stated_gain_percent: float
    depends_on: tuple[str, ...]
    shows_on: dict[str, float]
    joints_right: bool | None
    smooth_ratio: float | None
    seconds: float
    cpu_seconds: float
    memory_mb: float
    command: str
    false_fixes: int = 0

    @property
    def told_chi2(self) -> float:
        """Smallest `told_chi2` of the hidden effects."""
        return min((truth.told_chi2 for truth in self.truth), default=float("inf"))

    @property
    def false_causes(self) -> list[CauseJudged]:
        """Causes that are named and not there."""
        return [cause for cause in self.causes if not cause.is_right]


def written(key: Key) -> str:
    """Return the key as `effect@where:source`."""
    effect, where, source = key
    return effect + (f"@{where}" if where else "") + (f":{source}" if source else "")


class Crash(msgspec.Struct, frozen=True, tag="crashed"):
    """A case in which the diagnosis crashed."""

    scenario: str
    seed: int
    truth: tuple[str, ...]
    error: str
    command: str


def told(record: Judgement | Crash) -> str:
    """Return a record as one line of text."""
    if isinstance(record, Crash):
        return f"{record.scenario} {record.seed} crashed: {record.error.strip().splitlines()[-1]}"
    effects = [f"{written((t.effect, t.where, t.source))} ({t.size:.2g})" for t in record.truth]
    fixes = [f"{record.false_fixes} false fixes"] if record.false_fixes else []
    there = ", ".join(effects + fixes) or "nothing"
    named = (
        ", ".join(f"{written((c.effect, c.where, c.source))} {c.probability:.2f}" for c in record.causes) or "nothing"
    )
    case = f"{record.scenario} {record.seed} {record.outcome}"
    return f"{case}: {there} -> {named} [{record.verdict}] {record.seconds:.1f} s"
