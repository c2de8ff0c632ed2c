"""`diagnosis.json`: what was found, for machines."""

from __future__ import annotations

from typing import Literal

import msgspec

Verdict = Literal["explained", "nothing_found", "undecided", "unexplained"]


class Interval(msgspec.Struct, frozen=True):
    """A number with its 95 % interval."""

    value: float
    ci95: tuple[float, float]


class Gain(msgspec.Struct, frozen=True, rename={"from_": "from"}):
    """By how much the RMS falls on rows that were not fitted, counted from the aligned simulation [%]."""

    held_out_percent: float
    ci95: tuple[float, float]
    from_: str = "aligned"


class Indistinguishable(msgspec.Struct, frozen=True):
    """What a cause cannot be told from.

    Attributes:
        effect: its name; "unexplained" where it has none.
        by: "this_motion" where another motion would tell them apart, "any_motion" where none would.
        probability: that it is this one.
        what: in words, where it has no name.
    """

    effect: str
    where: str | None
    source: str | None
    by: Literal["this_motion", "any_motion"]
    probability: float
    what: str = ""


class Cause(msgspec.Struct, frozen=True):
    """One cause with its numbers.

    Attributes:
        stability_percent: how often it is named again from resampled blocks of time.
    """

    effect: str
    where: str | None
    source: str | None
    parameters: dict[str, Interval]
    probability: float
    share_of_gain_percent: float
    held_out_gain_percent: float
    stability_percent: float | None
    indistinguishable_from: tuple[Indistinguishable, ...]
    rivals: tuple[Indistinguishable, ...]
    evidence: str


class Rejected(msgspec.Struct, frozen=True):
    """A hypothesis that was tested and is not there.

    Attributes:
        held_out_gain_percent: what it would bring on top of the causes.
        p_value: of no gain at all, for all hypotheses that were tried together.
        why: it is no cause although chance hardly brings so much about; nothing where chance may.
    """

    effect: str
    where: str | None
    source: str | None
    held_out_gain_percent: float
    p_value: float
    why: str = ""


class Alike(msgspec.Struct, frozen=True):
    """Two effects at one joint that share a direction beside the best geometry, each taken alone.

    Attributes:
        effect: the one that explains most there.
        other: what says much the same.
        explains_percent, other_explains_percent: of the squared error that the best geometry leaves.
        shared_percent: of what `other` explains, `effect` explains so much too.
        delta_chi2: by how much more `effect` raises twice the log-likelihood.
    """

    where: str
    effect: str
    other: str
    explains_percent: float
    other_explains_percent: float
    shared_percent: float
    delta_chi2: float


class Unexplained(msgspec.Struct, frozen=True):
    """Structure that no effect fits: how large, on which joints it depends (`time` among them), how improbable.

    Attributes:
        what: what moves, and on what that depends, in words; the joints are named in `depends_on` too.
        model_joints: whose readings the smooth model in extended.toml takes.
        not_in_model: what of `what` changes with time, so that it is in no such model.
    """

    rms_mm: float
    depends_on: tuple[str, ...]
    p_value: float
    what: tuple[str, ...] = ()
    model_joints: tuple[str, ...] = ()
    not_in_model: tuple[str, ...] = ()


class Tolerances(msgspec.Struct, frozen=True):
    """How exactly the arm is made, what was found left aside: 1-sigma, each with its 95 % interval.

    Where the lower end is 0 the recording does not show them: they are no larger than the upper one.

    Attributes:
        length_mm: of the places of links.
        angle_deg: of axes and zeros.
        drive_deg: of the periodic errors of drives.
    """

    length_mm: Interval
    angle_deg: Interval
    drive_deg: Interval


class Pairs(msgspec.Struct, frozen=True):
    """How many pairs there were, were predicted without having been fitted, and were not the marker."""

    total: int
    held_out: int
    outliers: int


class Errors(msgspec.Struct, frozen=True):
    """Errors on rows that were not fitted [mm]."""

    nominal: float
    aligned: float
    geometry: float | None
    extended: float
    noise_floor: float | None


class Stability(msgspec.Struct, frozen=True):
    """How often the same causes come out of resampled blocks."""

    resampled: int
    same_causes: int


class DiagnosisFile(msgspec.Struct, frozen=True):
    """The contents of `diagnosis.json`.

    Attributes:
        seen_by: what measured the positions: a camera, or an instrument such as a laser tracker.
    """

    verdict: Verdict
    sentence: str
    pairs: Pairs
    rms_mm: Errors
    mean_mm: Errors
    gain: Gain
    causes: tuple[Cause, ...]
    rejected: tuple[Rejected, ...]
    unexplained: Unexplained
    stability: Stability | None
    advice: tuple[str, ...]
    limitations: tuple[str, ...]
    alike: tuple[Alike, ...] = ()
    tolerances: Tolerances | None = None
    seen_by: Literal["camera", "instrument"] = "camera"
    schema: int = 1
