"""The documents that the page is made of, besides both processes' own states."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

Process = Literal["sampler", "learner"]


class RobotDocument(msgspec.Struct, frozen=True):
    """What does not change: the robot's name, its joints, which of them slide, and this version."""

    robot: str
    joints: tuple[str, ...]
    slides: tuple[str, ...]
    version: str


class ProcessDocument(msgspec.Struct, frozen=True):
    """One of the processes.

    Attributes:
        answers: whether it is there now.
        endpoint: where it ought to be.
        heard: when it was heard last, UTC [s since 1970]; null before.
        problem: why what it said was not understood; null when it was.
        status: what it said last, with fields that this version does not know; null before.
    """

    answers: bool
    endpoint: str
    heard: float | None
    problem: str | None
    status: dict[str, Any] | None


class SeriesDocument(msgspec.Struct, frozen=True):
    """The course of figures since the view began, columns of equal length.

    Attributes:
        t: UTC [s since 1970].
        error_m: error on new pairs of the answering model [m], measurement noise included; null while there is none.
        claimed_m: the distance to the truth that the learner claims where data is [m].
        pairs_per_s: accepted pairs.
        predict_s: how long one prediction took, there and back [s]; null where none came.
    """

    t: list[float]
    error_m: list[float | None]
    claimed_m: list[float | None]
    pairs_per_s: list[float | None]
    predict_s: list[float | None]


class Change(msgspec.Struct, frozen=True):
    """A change of the tool, the camera or a joint's zero.

    Attributes:
        pairs: learnt before it.
        t: when the view heard of it, UTC [s since 1970].
        kind: as in the learner's status; null where learning began again from the prior.
        told: whether it was told; else the learner found it.
    """

    pairs: int
    t: float
    kind: str | None
    told: bool


class Version(msgspec.Struct, frozen=True):
    """A span of time in which the same kind of model answered.

    Attributes:
        since: UTC [s since 1970].
        first_pairs, pairs: pairs learnt when it began, and at last.
        answering: which model.
        model: hash of the newest of them.
        error_m: its error on new pairs [m].
        after_change: whether it began with a change of the tool.
    """

    since: float
    first_pairs: int
    pairs: int
    answering: str
    model: str
    error_m: float | None
    after_change: bool


class CourseDocument(msgspec.Struct, frozen=True):
    """What changed while the view looked on: the newest last."""

    changes: list[Change]
    versions: list[Version]


class Segment(msgspec.Struct, frozen=True):
    """A run of pairs.

    Attributes:
        utc: when its first known pair was accepted, ISO 8601.
        lasted_s: from its first to its last pair.
        complete: whether its first pair is known.
    """

    segment: int
    pairs: int
    utc: str
    lasted_s: float
    complete: bool


class CloudDocument(msgspec.Struct, frozen=True):
    """Where the marker was, and how far from there the model has it: pairs that were learnt already.

    Attributes:
        model: hash of the model that was asked; empty while none answers.
        x: measured positions [m], measurement frame.
        residual: measured - predicted [m].
        segment: of each row.
        median_m, p95_m: of the residuals' lengths; null without rows.
    """

    model: str
    x: list[list[float]]
    residual: list[list[float]]
    segment: list[int]
    median_m: float | None
    p95_m: float | None


class DiagnosisDocument(msgspec.Struct, frozen=True):
    """The diagnosis that was asked for last.

    Attributes:
        number: of the diagnosis, from 1; 0 before any.
        state: idle, copying (pairs from the sampler), running, done, failed or stopped.
        pairs: how many it has.
        said: what it is doing, what it found, or what went wrong.
        started: UTC [s since 1970].
        verdict: of diagnosis.json; null unless it is done.
        report: number of the diagnosis whose report there is to look at; null while there is none.
    """

    number: int = 0
    state: Literal["idle", "copying", "running", "done", "failed", "stopped"] = "idle"
    pairs: int = 0
    said: str = ""
    started: float | None = None
    verdict: str | None = None
    report: int | None = None
