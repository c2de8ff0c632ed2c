"""What nobody knows where a run begins: on which side of its play a joint is, and how far it was from rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects.flank import flanks

from .fit import Fit

# A joint that has made up for all but so much of what it lacked is at rest.
_AT_REST = 0.05
# A joint that has gone so many lengths of its hysteresis is strained as its last direction has it.
_STRAINED = 3.0
# Friction of a loaded play is known to within this factor, and a load that is a smaller share of the largest is none.
_FRICTION_WITHIN, _UPRIGHT = 2.0, 0.02


def before_contact(fit: Fit) -> NDArray[np.bool_]:
    """Rows (n,) at which nobody knows on which side of its play a joint is: it has not crossed it in this run yet."""
    motion = fit.observations.motion
    rows = np.zeros(len(motion), dtype=np.bool_)
    for effect in fit.simulation.effects:
        if effect.name not in ("backlash", "hysteresis"):
            continue
        reach = effect.values[0] if effect.name == "backlash" else _STRAINED * effect.values[1]
        q = motion.q[:, fit.simulation.place(effect).joint]
        for first, end in motion.runs:
            crossed = np.maximum.accumulate(q[first:end]) - np.minimum.accumulate(q[first:end]) >= reach
            rows[first:end] |= ~crossed
    return rows


def before_rest(fit: Fit) -> NDArray[np.bool_]:
    """Rows (n,), but for the first of a run, at which a joint still lacks some of what it lacked as the run began."""
    motion = fit.observations.motion
    memory = max((effect.value("memory") for effect in fit.simulation.effects if effect.name == "settling"), default=0)
    rows = np.zeros(len(motion), dtype=np.bool_)
    if memory > 0.0:
        for first, end in motion.runs:
            rows[first + 1 : end] = memory ** np.cumsum(motion.pace[first + 1 : end]) > _AT_REST
    return rows


def between_flanks(fit: Fit) -> NDArray[np.bool_]:
    """Rows (n,) at which the flank that a loaded play hangs on depends on how large its friction is."""
    rows = np.zeros(len(fit.observations.motion), dtype=np.bool_)
    for effect in fit.simulation.effects:
        if effect.name != "gravity_backlash":
            continue
        torque, hold = fit.run.torques[:, fit.simulation.place(effect).joint], float(effect.values[1])
        less, more = hold / _FRICTION_WITHIN, hold * _FRICTION_WITHIN + _UPRIGHT * float(np.abs(torque).max())
        rows |= flanks(torque, less) != flanks(torque, more)
    return rows


def doubtful(fit: Fit) -> NDArray[np.bool_]:
    """Rows (n,) whose past is not known well enough."""
    return before_contact(fit) | before_rest(fit) | between_flanks(fit)
