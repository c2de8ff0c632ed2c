"""How sure each cause is, and what else it could be: told apart by this recording, by another motion, or by none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from effects import Effect, Motion
from interfaces.records import FloatArray

from .fit import Fit
from .held_out import without_cause
from .scan import Candidate, Scan
from .search import Search, nats

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
        effect: with the numbers with which it does best.
        probability: given that one of the rivals is there.
        difference: twice the log-likelihood that this motion is expected to tell them apart by.
        anywhere: the same for as many poses over the whole range of the joints.
    """

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
        probability: of the cause, or of what no motion tells from it.
        worth: how much more probable the causes are with it than without any in its place [nats].
        dof: how many of its amounts the data tell.
        gain: twice the log-likelihood that it brings.
        rivals: the probable ones, the most probable first.
    """

    probability: float
    worth: float
    dof: int
    gain: float
    rivals: tuple[Rival, ...]


def standings(fit: Fit, hypotheses: Sequence[Effect], search: Search) -> list[Standing]:
    """One for each cause of a fit."""
    return [_standing(fit, cause, hypotheses, search) for cause in fit.causes]


def _standing(fit: Fit, cause: Effect, hypotheses: Sequence[Effect], search: Search) -> Standing:
    without = without_cause(fit, cause)
    gain = 2.0 * (fit.log_likelihood - without.log_likelihood)
    itself = Scan(without).candidate(cause) or Candidate(cause, gain, 1)
    worth = nats(gain, itself.dof) - search.doubt(itself)
    present = {effect.key for effect in fit.causes}
    others = [h for h in hypotheses if h.key not in present]
    tried = []
    for candidate in search.shortlist(without, others):
        if candidate.gain < _COMES_NEAR * itself.gain:
            continue
        rival = search.refined(without.with_causes([*without.causes, candidate.effect]), candidate.effect.key)
        behind = nats(2.0 * (rival.log_likelihood - fit.log_likelihood), candidate.dof - itself.dof)
        tried.append(
            (rival, candidate.effect.key, behind - np.log(max(candidate.trials / max(itself.trials, 1), 1e-3)))
        )
    odds = np.exp(np.clip([0.0, -worth, *(behind for _, _, behind in tried)], -500.0, 50.0))
    shares = odds / odds.sum()
    rivals = [
        Rival(_effect(rival, key), float(share), _difference(fit, rival), _anywhere(fit, rival))
        for (rival, key, _), share in zip(tried, shares[2:], strict=True)
        if share >= PROBABLE
    ]
    same = sum(rival.probability for rival in rivals if rival.is_same_anywhere)
    ordered = tuple(sorted(rivals, key=lambda rival: rival.probability, reverse=True))
    return Standing(float(shares[0]) + same, worth, itself.dof, gain, ordered)


def _effect(fit: Fit, key: tuple[str, str | None, str | None]) -> Effect:
    return next(effect for effect in fit.causes if effect.key == key)


def _difference(one: Fit, other: Fit) -> float:
    """Twice the log-likelihood by which the predictions of two fits differ over their observations."""
    apart = one.observations.whitened((one.run.measured - other.run.measured)[:, :, None])[:, :, 0]
    return float((one.noise.weights[:, None] * np.square(apart)).sum() / one.noise.sigma**2)


def _anywhere(one: Fit, other: Fit) -> float:
    """The same for poses over the whole range of the joints, with what may be fitted to them refitted."""
    robot = one.simulation.robot
    rng = np.random.default_rng(0)
    n = len(one.observations)
    chosen = np.sort(rng.integers(n, size=min(n, _POSES)))
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    q = rng.uniform(lower, upper, (len(chosen), len(lower)))
    motion = one.observations.motion
    t = None if motion.t is None else np.linspace(motion.t[0], motion.t[-1], len(chosen))
    wide = Motion(q, t, np.arange(len(chosen)) // 2)
    if t is None:
        wide = Motion(q, np.linspace(0.0, float(n), len(chosen)), wide.segment)
    apart = one.simulation.positions(wide) - other.simulation.positions(wide)
    left = _beside(apart, other, wide)
    scale = np.linalg.det(one.observations.whitening[chosen]) ** (1.0 / 3.0)
    return float(np.square(left * scale[:, None]).sum() / one.noise.sigma**2 * n / len(chosen))


def _beside(apart: FloatArray, fit: Fit, motion: Motion) -> FloatArray:
    """What of `apart` (n, 3) the amounts of a fit cannot follow."""
    run = fit.simulation.run(motion)
    columns = [run.columns(effect)[:, :, effect.amounts] for effect in fit.simulation.effects]
    flat = np.concatenate(columns, axis=2).reshape(apart.size, -1)
    scales = np.linalg.norm(flat, axis=0)
    flat = flat / np.where(scales > 0.0, scales, 1.0)
    solved = np.linalg.lstsq(flat, apart.ravel(), rcond=1e-9)[0]
    return (apart.ravel() - flat @ solved).reshape(apart.shape)
