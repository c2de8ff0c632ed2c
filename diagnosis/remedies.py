"""Advise what to do about each cause, with numbers: ticks to write, lines of robot.toml and URDF, screws to tighten."""

from __future__ import annotations

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

from .numbers import named, rival_named
from .presenters.presenter import Found, Workshop
from .presenters.registry import presenter_of
from .result import Cause, DiagnosisFile

# A less probable cause is to be confirmed first.
_SURE = 0.9


def remedies(
    diagnosis: DiagnosisFile, robot: RobotDescription, steps: FloatArray, torques: FloatArray | None
) -> list[str]:
    """Return advice on each cause, the one that explains most first.

    Args:
        steps: encoder step of each joint (d,) [rad, m]; 0 where it is unknown.
        torques: the largest torque of gravity on each joint (d,) [N·m, N]; None where masses are unknown.
    """
    workshop = Workshop(robot, steps, torques, {cause.effect: cause for cause in diagnosis.causes})
    causes = sorted(diagnosis.causes, key=lambda cause: -cause.share_of_gain_percent)
    told = [presenter_of(cause.effect).remedy(workshop, Found.of(cause)) for cause in causes]
    return [_if_sure(cause, remedy) for cause, remedy in zip(causes, told, strict=True)]


def _if_sure(cause: Cause, remedy: str) -> str:
    """Return the remedy, preceded by what to confirm before any change."""
    open_ones = [rival for rival in cause.rivals if rival.by == "this_motion"]
    if cause.probability >= _SURE or not open_ones:
        return remedy
    rivals = " or ".join(rival_named(rival) for rival in open_ones[:2])
    return (
        f"If it is {named(cause.effect, cause.where, cause.source)} and not {rivals}: {remedy[0].lower()}{remedy[1:]}"
    )
