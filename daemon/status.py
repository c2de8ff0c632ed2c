"""What the two processes say of themselves, under `status/sampler` and `status/learner`."""

from __future__ import annotations

import msgspec

from .wire import SCHEMA


class JointRange(msgspec.Struct, frozen=True):
    """The part of one joint's range that accepted pairs have covered [rad or m]."""

    low: float
    high: float
    lower_limit: float
    upper_limit: float


class SamplerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the sampler.

    Attributes:
        store: identity of the store.
        state: running, paused, ended (the source is through) or failed.
        pairs: accepted pairs in the store, which is also the newest sequence number.
        segment: number of the current segment.
        frames: frames taken since the start.
        rejected: frames that did not become pairs, by reason.
        coverage: by joint.
        health: sentences about what is wrong; empty when all is well.
    """

    robot: str
    store: str
    state: str
    pairs: int
    segment: int
    uptime_s: float
    frames: int
    frames_per_s: float
    readings_per_s: float
    pairs_per_s: float
    rejected: dict[str, int]
    coverage: dict[str, JointRange]
    disk_free_bytes: int
    health: list[str]
    version: str
    schema: int = SCHEMA


class CurvePoint(msgspec.Struct, frozen=True, array_like=True):
    """One point of the learning curve: prequential error, before the pair was learnt."""

    pairs: int
    error_m: float


class LearnerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the learner.

    Attributes:
        store: identity of the store the pairs came from, or null before any.
        state: waiting (no pair yet), aligning (the frame is not known yet), learning or paused.
        pairs: pairs learnt online, each once.
        last_seq: sequence number of the newest of them.
        replayed: replay steps since the start.
        pairs_since_change: pairs since the tool was last changed, or since the beginning.
        answering: which model answers queries.
        prequential_m: recent mean distance between prediction and measurement, before learning [m], by model.
        claimed_error_m: the error [m] that the learner claims for predictions where data is.
        curve: the learning curve of the answering model.
        model: hash of the model that answers.
        gaps_recovered: pairs that had to be fetched from the sampler's history.
        refused: pairs that could not be taken.
        doubted: pairs that looked like gross outliers and were learnt with care.
        changes: tool changes that were told, or found in the pairs.
        checkpoint_age_s: time since the last checkpoint, or null before any.
        health: sentences about what is wrong; empty when all is well.
    """

    robot: str
    store: str | None
    state: str
    pairs: int
    last_seq: int
    pairs_since_change: int
    sampler_alive: bool
    replayed: int
    answering: str
    prequential_m: dict[str, float]
    claimed_error_m: float | None
    curve: list[CurvePoint]
    model: str
    gaps_recovered: int
    refused: int
    doubted: int
    changes: int
    checkpoint_age_s: float | None
    uptime_s: float
    health: list[str]
    version: str
    schema: int = SCHEMA
