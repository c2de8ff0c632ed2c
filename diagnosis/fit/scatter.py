"""Keep noise of single encoder readings from looking like backlash or lag."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodyschema.effects import Effect, Motion
from bodyschema.interfaces.records import FloatArray

from .fit import Fit


class _Settings:
    # Move beyond which the readings' noise does not matter, in multiples of it: a backlash needs only the direction of
    # the move, other effects its size.
    play_far, far = 4.0, 20.0
    max_of_a_row_nats = 1.0  # largest evidence of one row for one memory effect over another [nats]


def remembers(effect: Effect) -> bool:
    """Return True if an effect derives a joint's position from past readings, which reading noise can imitate."""
    return effect.kind.remembers


def instruments(fit: Fit, effect: Effect) -> FloatArray:
    """Return weighted columns (n, 3, k) of an effect's amounts as instruments that are robust to reading noise.

    A backlash or a lag puts a joint nearer to the previous reading. Noise of the reading itself looks the same. So the
    columns of a row are computed from its neighbours' readings and not from its own, which is in the row's residual: an
    instrumental variable (Durbin 1954). Without such an effect, its product with the residual has zero expectation,
    however large the noise, provided that the noise is independent between rows. Only after a long move of the joint
    does its own reading determine the direction as well.
    """
    if not remembers(effect):
        return fit.weighted(fit.run.columns(effect)[:, :, effect.amounts])
    motion, joint = fit.observations.motion, fit.simulation.robot.joints.index(str(effect.where))
    between = _between(fit, motion, joint, _Settings.play_far if effect.kind.by_direction else _Settings.far)
    columns = np.empty((len(motion), 3, len(effect.amounts)))
    # Effects determined by the readings alone have the same columns, which take long to compute.
    simulation = replace(fit.simulation, residual=None)
    # Replace alternate rows, so that each row's neighbours keep their own readings.
    for every_other in (slice(0, None, 2), slice(1, None, 2)):
        q = motion.q.copy()
        q[every_other, joint] = between[every_other]
        run = simulation.run(replace(motion, q=q))
        columns[every_other] = run.columns(effect)[every_other][:, :, effect.amounts]
    return fit.weighted(columns)


def beyond_single_rows(one: Fit, other: Fit) -> float:
    """Return the correction to the log-likelihood of `other` over `one` that limits the weight of each row [nats].

    Only rows after a short move distinguish the memory effects of a joint. They are few, so a single outlier may
    decide: the first row after a bump, or a joint that the motion of another one pushed across its backlash.
    """
    return float((limited_rows(one, other) - (other.row_log_likelihoods - one.row_log_likelihoods)).sum())


def limited_rows(one: Fit, other: Fit) -> FloatArray:
    """Return the log-likelihood of `other` over `one` at each row (n,), with its weight limited [nats]."""
    most = _Settings.max_of_a_row_nats
    return np.clip(other.row_log_likelihoods - one.row_log_likelihoods, -most, most)


def _between(fit: Fit, motion: Motion, joint: int, far: float) -> FloatArray:
    """Return a joint's position by the readings before and after each (n,) [rad, m]; its own after a long move."""
    q, after = motion.q[:, joint], np.append(~motion.begins[1:], False)
    before = np.where(motion.begins, q, np.roll(q, 1))
    before = np.where(motion.begins & after, np.roll(q, -1), before)
    between = 0.5 * (before + np.where(after, np.roll(q, -1), before))
    return np.where(np.abs(motion.moves[:, joint]) > far * _most_scatter(fit, joint), q, between)


def _most_scatter(fit: Fit, joint: int) -> float:
    """Return the upper bound of a joint's reading noise, 1-sigma [rad, m]: all residuals attributed to it."""
    by_joint = fit.weighted(fit.run.by_joint[:, :, [joint]])[:, :, 0]
    lengths = np.square(by_joint).sum(axis=1)
    along = np.einsum("ni,ni->n", by_joint, fit.weighted_residuals)
    return float(np.sqrt((np.square(along) / np.maximum(lengths, 1e-300)).sum() / max(lengths.sum(), 1e-300)))
