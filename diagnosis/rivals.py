"""How sure each cause is, and what else it could be: told apart by this recording, by another motion, or by none."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from effects import Effect, Motion
from interfaces.records import FloatArray

from .fit import Fit
from .held_out import Blocks
from .scan import Candidate
from .search import Search, nats
from .stability import Instead, named_again

# Signals that differ by less than this, twice the log-likelihood that the right one is expected to gain, are one.
SAME = 6.0
# A rival less probable than this is none.
PROBABLE = 0.02
# What explains a smaller share of what a cause explains is none either.
_COMES_NEAR = 0.7
# Poses of the motion over the whole range of the joints, which stands for any motion.
_POSES = 400


@dataclass(frozen=True, eq=False)
class Rival:
    """What could be there in the place of a cause.

    Attributes:
        fit: with it in the place of the cause.
        effect: with the numbers with which it does best.
        probability: given that one of the rivals is there.
        difference: twice the log-likelihood that this motion is expected to tell them apart by.
        anywhere: the same for as many poses over the whole range of the joints.
    """

    fit: Fit
    effect: Effect
    probability: float
    difference: float
    anywhere: float

    @property
    def is_same_here(self) -> bool:
        """Whether no data of this motion tells it from the cause."""
        return self.difference < SAME

    @property
    def is_same_anywhere(self) -> bool:
        """Whether no motion does."""
        return self.anywhere < SAME


@dataclass(frozen=True, eq=False)
class Standing:
    """How one cause stands against all others.

    Attributes:
        itself: the cause as it would explain most there.
        probability: of the cause, or of what no motion tells from it.
        worth: how much more probable the causes are with it than without any in its place [nats].
        dof: how many of its amounts the data tell.
        gain: twice the log-likelihood that it brings.
        rivals: the probable ones, the most probable first.
        again: in which of some resamplings of the blocks of time it would be named again.
    """

    itself: Candidate
    probability: float
    worth: float
    dof: int
    gain: float
    rivals: tuple[Rival, ...]
    again: NDArray[np.bool_]


def standings(fit: Fit, search: Search, blocks: Blocks, seed: int) -> list[Standing]:
    """One for each cause of a fit."""
    return [_standing(fit, cause, search, blocks, seed) for cause in fit.causes]


def _standing(fit: Fit, cause: Effect, search: Search, blocks: Blocks, seed: int) -> Standing:
    beside = search.beside(fit, cause)
    without = beside.without
    gain = 2.0 * (fit.log_likelihood - without.log_likelihood)
    itself = beside.itself or Candidate(cause, gain, 1)
    worth = nats(gain, itself.dof) - search.doubt(itself)
    nothing = Instead(without, -itself.dof, -search.doubt(itself))
    tried = []
    for candidate in beside.candidates:
        if candidate.gain < _COMES_NEAR * itself.gain:
            continue
        rival = search.refined(without.with_causes([*without.causes, candidate.effect]), candidate.effect)
        doubt = float(np.log(max(candidate.trials / max(itself.trials, 1), 1e-3)))
        tried.append((Instead(rival, candidate.dof - itself.dof, doubt), candidate.effect))
    behind = [nats(2.0 * (one.fit.log_likelihood - fit.log_likelihood), one.dof) - one.doubt for one, _ in tried]
    odds = np.exp(np.clip([0.0, -worth, *behind], -500.0, 50.0))
    shares = odds / odds.sum()
    rivals = [
        Rival(one.fit, _as_fitted(one.fit, effect), float(share), _difference(fit, one.fit), _anywhere(fit, one.fit))
        for (one, effect), share in zip(tried, shares[2:], strict=True)
        if share >= PROBABLE
    ]
    same = sum(rival.probability for rival in rivals if rival.is_same_anywhere)
    ordered = tuple(sorted(rivals, key=lambda rival: rival.probability, reverse=True))
    return Standing(
        itself,
        float(shares[0]) + same,
        worth,
        itself.dof,
        gain,
        ordered,
        named_again(fit, nothing, [one for one, _ in tried], blocks, seed),
    )


def _as_fitted(fit: Fit, effect: Effect) -> Effect:
    return next(cause for cause in fit.causes if cause.identity == effect.identity)


def _difference(one: Fit, other: Fit) -> float:
    """Twice the log-likelihood by which the predictions of two fits differ over their observations."""
    apart = one.observations.whitened((one.run.measured - other.run.measured)[:, :, None])[:, :, 0]
    return float((one.noise.weights[:, None] * np.square(apart)).sum() / one.noise.sigma**2)


def _anywhere(one: Fit, other: Fit) -> float:
    """The same for poses over the whole range of the joints, with what may be fitted to them refitted."""
    return apart_on(one, other, widened(one, range(one.observations.motion.q.shape[1])))


def widened(fit: Fit, joints: Iterable[int]) -> Motion:
    """Some rows of a fit's motion, with some joints anywhere in their range, each pose followed by one nearby."""
    robot, motion = fit.simulation.robot, fit.observations.motion
    rng = np.random.default_rng(0)
    n = len(motion)
    rows = np.sort(rng.integers(n, size=min(n, _POSES)))
    q = motion.q[rows].copy()
    for k in joints:
        q[:, k] = rng.uniform(max(robot.lower[k], -np.pi), min(robot.upper[k], np.pi), len(rows))
    clock = motion.clock
    return Motion(q, np.linspace(clock[0], clock[-1], len(rows)), np.arange(len(rows)) // 2)


def apart_on(one: Fit, other: Fit, motion: Motion) -> float:
    """Twice the log-likelihood by which two fits differ on a motion as long as theirs, the other refitted to it."""
    apart = one.simulation.positions(motion) - other.simulation.positions(motion)
    left = _beside(apart, other, motion)
    scale = float(np.median(np.linalg.det(one.observations.whitening))) ** (1.0 / 3.0)
    share = len(one.observations) / len(motion)
    return float(np.square(left * scale).sum() / one.noise.sigma**2 * share)


def _beside(apart: FloatArray, fit: Fit, motion: Motion) -> FloatArray:
    """What of `apart` (n, 3) the amounts of a fit cannot follow."""
    run = fit.simulation.run(motion)
    columns = [run.columns(effect)[:, :, effect.amounts] for effect in fit.simulation.effects]
    flat = np.concatenate(columns, axis=2).reshape(apart.size, -1)
    scales = np.linalg.norm(flat, axis=0)
    flat = flat / np.where(scales > 0.0, scales, 1.0)
    solved = np.linalg.lstsq(flat, apart.ravel(), rcond=1e-9)[0]
    return (apart.ravel() - flat @ solved).reshape(apart.shape)
