"""Find rows at which the state of a joint is unknown: its side of the backlash, or its distance from rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects.flank import flanks

from .fit import Fit

# A settling joint is at rest when this share of its initial lag remains.
_AT_REST = 0.05
# After this many hysteresis lengths, only the last direction determines the strain.
_STRAINED = 3.0
# Uncertainty factor of the friction in a loaded backlash, and the smallest relative load that counts.
_FRICTION_WITHIN, _UPRIGHT = 2.0, 0.02


def before_contact(fit: Fit) -> NDArray[np.bool_]:
    """Return rows (n,) before a joint first crosses its backlash in a run; its side is unknown until then."""
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
    """Return rows (n,), except the first of a run, at which a joint has not settled from before the run."""
    motion = fit.observations.motion
    memory = max((effect.value("memory") for effect in fit.simulation.effects if effect.name == "settling"), default=0)
    rows = np.zeros(len(motion), dtype=np.bool_)
    if memory > 0.0:
        for first, end in motion.runs:
            rows[first + 1 : end] = memory ** np.cumsum(motion.pace[first + 1 : end]) > _AT_REST
    return rows


def between_flanks(fit: Fit) -> NDArray[np.bool_]:
    """Return rows (n,) at which the contact side of a loaded backlash depends on the size of its friction."""
    rows = np.zeros(len(fit.observations.motion), dtype=np.bool_)
    for effect in fit.simulation.effects:
        if effect.name != "gravity_backlash":
            continue
        torque, hold = fit.run.torques[:, fit.simulation.place(effect).joint], float(effect.values[1])
        less, more = hold / _FRICTION_WITHIN, hold * _FRICTION_WITHIN + _UPRIGHT * float(np.abs(torque).max())
        rows |= flanks(torque, less) != flanks(torque, more)
    return rows


def doubtful(fit: Fit) -> NDArray[np.bool_]:
    """Return rows (n,) whose history is not known well enough."""
    return before_contact(fit) | before_rest(fit) | between_flanks(fit)
