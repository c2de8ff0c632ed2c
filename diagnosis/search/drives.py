"""Add small periodic drive errors to the background, one by one, beyond those that every drive has."""

from __future__ import annotations

import numpy as np

from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.worth import NAMED, nats, rise_for
from bodyschema.effects import Effect

from .scan import Scan

# Maximum of rounds; each may add one ripple per joint.
_ROUNDS = 8
# Ripples whose phases differ by less over a joint's range are the same [turns].
_APART = 0.75


def with_small_ripples(fit: Fit) -> Fit:
    """Add to the background the ripples that the data show and that are no larger than the drive tolerance."""
    scales = fit.background.scales
    if scales is None:
        return fit
    for _ in range(_ROUNDS):
        robot, scan = fit.simulation.robot, Scan(fit)
        moving = np.flatnonzero(np.ptp(fit.observations.motion.q, axis=0) > 0.0)
        found: list[Effect] = []
        least = 2.0 * rise_for(NAMED + np.log(len(moving)), 2)
        for k in moving:
            candidate = scan.candidate(Effect.at(robot, "joint_ripple", robot.joints[k]), least)
            if candidate is None or not fit.background.tolerates(candidate.effect) or _is_there(fit, candidate.effect):
                continue
            if nats(candidate.gain, candidate.dof) - np.log(len(moving) * candidate.trials) > NAMED:
                found.append(candidate.effect)
        if not found:
            break
        fit = fit.tolerating(scales, found)
    return fit


def _is_there(fit: Fit, ripple: Effect) -> bool:
    """Return True if a fit already has a ripple of so similar a period that the two could cancel."""
    joint = fit.simulation.robot.joints.index(str(ripple.where))
    span = float(np.ptp(fit.observations.motion.q[:, joint])) / (1.0 if ripple.prismatic else 2.0 * np.pi)
    others = [effect for effect in (*fit.causes, *fit.background.effects) if effect.kind is ripple.kind]
    return any(
        effect.where == ripple.where and abs(float(effect.values[-1] - ripple.values[-1])) * span < _APART
        for effect in others
    )
