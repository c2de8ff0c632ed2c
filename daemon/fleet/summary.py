"""What the diagnoses of a fleet say together: which unit is off, and what all of a type share."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from bodyschema.diagnosis.numbers import numbers_of, place, telling
from bodyschema.diagnosis.result import Cause, DiagnosisFile

from .diagnosing import Diagnosed

# Of so many units at least, a cause that more than half of them have is the description's rather than theirs.
FEWEST_TO_SHARE = 3
# Causes that say how the robot is placed, which is no matter of its type.
PLACED = ("camera_pose", "camera_moved", "tool_offset", "tool_slip")


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One recording.

    Attributes:
        name: of the row, and of the report's folder.
        causes: with their numbers, in words, the most telling first.
        gain_percent: by how much the RMS falls on rows that were not fitted.
        aligned_mm, extended_mm: RMS there, without and with the causes.
        error: why there is no diagnosis; then the others are null.
    """

    name: str
    recording: str
    robot: str
    verdict: str | None
    causes: tuple[str, ...]
    gain_percent: float | None
    aligned_mm: float | None
    extended_mm: float | None
    sentence: str | None
    error: str | None


class Shared(msgspec.Struct, frozen=True):
    """A cause that more than half of the units of a type have.

    Attributes:
        cause: effect and joint.
        units: which have it.
        of: how many units were diagnosed.
    """

    cause: str
    units: tuple[str, ...]
    of: int


class Type(msgspec.Struct, frozen=True):
    """Units with the same joints.

    Attributes:
        well: units with which nothing is wrong.
        off: by unit, what it alone, or hardly another, has.
        shared: what most have: look at the description that they share.
    """

    joints: tuple[str, ...]
    well: tuple[str, ...]
    off: dict[str, tuple[str, ...]]
    shared: tuple[Shared, ...]


class Summary(msgspec.Struct, frozen=True):
    """All of it."""

    rows: tuple[Row, ...]
    types: tuple[Type, ...]


def summary(results: Sequence[Diagnosed]) -> Summary:
    """The summary of what came of the recordings."""
    types: dict[tuple[str, ...], list[Diagnosed]] = {}
    for result in results:
        if result.file is not None:
            types.setdefault(result.joints, []).append(result)
    return Summary(tuple(map(row, results)), tuple(_type(joints, units) for joints, units in types.items()))


def row(result: Diagnosed) -> Row:
    """One recording's row."""
    file = result.file
    return Row(
        name=result.job.name,
        recording=str(result.job.recording),
        robot=result.robot,
        verdict=None if file is None else file.verdict,
        causes=() if file is None else tuple(_told(cause, result.timed) for cause in _by_share(file)),
        gain_percent=None if file is None else file.gain.held_out_percent,
        aligned_mm=None if file is None else file.rms_mm.aligned,
        extended_mm=None if file is None else file.rms_mm.extended,
        sentence=None if file is None else file.sentence,
        error=result.error,
    )


def _by_share(file: DiagnosisFile) -> list[Cause]:
    return sorted(file.causes, key=lambda cause: -cause.share_of_gain_percent)


def _told(cause: Cause, timed: bool) -> str:
    """A cause with its numbers, as `joint_scale at elbow: scale +2.01 ± 0.03 %`."""
    numbers = ", ".join(f"{number.label} {number}" for number in telling(numbers_of(cause, timed=timed)))
    return f"{place(cause)}: {numbers}" if numbers else place(cause)


def _type(joints: tuple[str, ...], units: Sequence[Diagnosed]) -> Type:
    has: dict[str, list[str]] = {}
    for unit in units:
        for cause in unit.file.causes if unit.file is not None else ():
            if cause.effect not in PLACED:
                has.setdefault(place(cause), []).append(unit.job.name)
    common = {cause for cause, names in has.items() if len(units) >= FEWEST_TO_SHARE and 2 * len(names) > len(units)}
    off: dict[str, tuple[str, ...]] = {}
    for unit in units:
        if unit.file is None or unit.file.verdict == "nothing_found":
            continue
        own = [_told(cause, unit.timed) for cause in _by_share(unit.file) if place(cause) not in common]
        if unit.file.unexplained.depends_on:
            own.append(f"something unexplained that depends on {', '.join(unit.file.unexplained.depends_on)}")
        if own:
            off[unit.job.name] = tuple(own)
    well = tuple(u.job.name for u in units if u.file is not None and u.file.verdict == "nothing_found")
    shared = tuple(Shared(cause, tuple(has[cause]), len(units)) for cause in has if cause in common)
    return Type(joints, well, off, shared)
