"""Advise what to measure next where a question is still open."""

from __future__ import annotations

import numpy as np

from bodyschema.effects import Effect

from .diagnosis import Diagnosis
from .nameless import Nameless
from .rivals import Rival, apart_on, whole_range, widened
from .search import describe

# Smallest Δχ² between two causes at which a motion is worth advising.
_TELLS = 25.0
# Measurements that reveal an unnamed cause.
_WATCH = {
    "joint": "compare its reading with an angle that is measured otherwise",
    "body": "press on it, or record with a second marker on what carries it",
    "place": "calibrate the cameras again, where they stand to each other too",
}


def advice(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return sentences of advice: motions that would separate confounded causes, and steps against unnamed causes."""
    told = []
    for cause, standing in zip(diagnosis.causes, diagnosis.standings, strict=True):
        for rival in standing.rivals:
            if not rival.is_same_anywhere:
                told.append(_motion(diagnosis, cause, rival))
            elif not rival.is_one:
                told.append(
                    f"{rival.described} can do all that {describe(cause)} does, and more: "
                    "a longer recording of the same kind would show whether it does."
                )
            elif rival.effect is not None:
                told.append(f"No motion tells {describe(cause)} from {rival.described}: fix whichever is easier.")
            if isinstance(rival.instead, Nameless):
                told.append(f"Watch whether {rival.described}: {_WATCH[rival.instead.kind]}.")
    if diagnosis.left.is_there:
        joints = [diagnosis.extended.simulation.robot.joints[k] for k in diagnosis.left.joints]
        where = f" Look at {', '.join(joints)} first." if joints else ""
        told.append(f"None of the known effects fits {'; '.join(diagnosis.left.what)}.{where}{_reach(diagnosis)}")
    return tuple(dict.fromkeys(told))


def _reach(diagnosis: Diagnosis) -> str:
    stored = diagnosis.left.model is not None and diagnosis.left.model.stored is not None
    return " The extended simulation is right about it only where the recording has been." if stored else ""


def _motion(diagnosis: Diagnosis, cause: Effect, rival: Rival) -> str:
    """Return advice on the joint that, moved through its whole range, best separates two causes."""
    robot, fit = diagnosis.extended.simulation.robot, diagnosis.extended
    pair = f"{describe(cause)} from {rival.described}"
    apart = [apart_on(fit, rival.instead, widened(fit, [k])) for k in range(len(robot.joints))]
    best = int(np.argmax(apart))
    if apart[best] >= _TELLS:
        low, high = whole_range(fit, best)
        unit, scale = ("mm", 1e3) if robot.chain.prismatic[best] else ("°", 180.0 / np.pi)
        span = f"{low * scale:.0f}{unit} to {high * scale:.0f}{unit}"
        return f"To tell {pair}, move joint {robot.joints[best]} through its whole range ({span}) in another recording."
    poses = f"To tell {pair}, record poses over the whole range of all joints, with stops and at different speeds"
    if rival.anywhere >= _TELLS:
        return f"{poses}."
    pairs = len(fit.observations) * _TELLS / rival.anywhere
    return f"{poses}: about {float(f'{pairs:.1g}'):,.0f} of them, since the effect is small beside the noise."
