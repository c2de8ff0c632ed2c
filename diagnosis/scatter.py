"""What the scatter of single readings makes of a joint that seems to remember its way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodyschema.effects import Effect, Motion
from bodyschema.interfaces.records import FloatArray

from .fit import Fit

# Beside a move of how many times the readings' scatter that does not matter: to a play it is which way the joint came,
# to anything else how far.
_PLAY_FAR, _FAR = 4.0, 20.0


def remembers(effect: Effect) -> bool:
    """Whether an effect says where a joint is by its last readings, so that their scatter looks like it."""
    return effect.kind.encoder is not None and effect.kind.encoder.remembers


def instruments(fit: Fit, effect: Effect) -> FloatArray:
    """Weighted columns (n, 3, k) of an effect's amounts, by which a test of it does not fall for readings' scatter.

    A play or a lag takes a joint to be nearer to the reading before, which is right of a reading that is off by itself,
    and a gain that no gear has. What an effect does at a row is therefore worked out from its neighbours' readings and
    not from its own, which is in the row's residual: an instrumental variable (Durbin 1954), whose product with the
    residual has no expectation where there is no such effect, however large the scatter, as long as readings are off
    independently. Only where the joint has come from far, its own reading tells the way as well.
    """
    if not remembers(effect):
        return fit.weighted(fit.run.columns(effect)[:, :, effect.amounts])
    motion, joint = fit.observations.motion, fit.simulation.robot.joints.index(str(effect.where))
    between = _between(fit, motion, joint, _PLAY_FAR if effect.name == "backlash" else _FAR)
    columns = np.empty((len(motion), 3, len(effect.amounts)))
    # Of each two rows one is replaced at a time, so that its neighbours are as they were read.
    for every_other in (slice(0, None, 2), slice(1, None, 2)):
        q = motion.q.copy()
        q[every_other, joint] = between[every_other]
        run = fit.simulation.run(replace(motion, q=q))
        columns[every_other] = run.columns(effect)[every_other][:, :, effect.amounts]
    return fit.weighted(columns)


def _between(fit: Fit, motion: Motion, joint: int, far: float) -> FloatArray:
    """Where a joint is by the readings before and after each (n,) [rad, m]; its own where it has come from far."""
    q, after = motion.q[:, joint], np.append(~motion.begins[1:], False)
    before = np.where(motion.begins, q, np.roll(q, 1))
    before = np.where(motion.begins & after, np.roll(q, -1), before)
    between = 0.5 * (before + np.where(after, np.roll(q, -1), before))
    return np.where(np.abs(motion.moves[:, joint]) > far * _most_scatter(fit, joint), q, between)


def _most_scatter(fit: Fit, joint: int) -> float:
    """What a joint's readings can scatter at most, 1-sigma [rad, m]: as if all that is left came from it."""
    by_joint = fit.weighted(fit.run.by_joint[:, :, [joint]])[:, :, 0]
    lengths = np.square(by_joint).sum(axis=1)
    along = np.einsum("ni,ni->n", by_joint, fit.left)
    return float(np.sqrt((np.square(along) / np.maximum(lengths, 1e-300)).sum() / max(lengths.sum(), 1e-300)))
