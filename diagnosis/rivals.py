"""How sure each cause is, and what else it could be: told apart by this recording, by another motion, or by none."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects import Effect, Motion
from bodyschema.interfaces.records import FloatArray

from .fit import Fit, amount_columns
from .held_out import Blocks
from .nameless import Nameless
from .scan import Candidate
from .scatter import remembers
from .search import Search, describe, nats
from .stability import Instead, named_again
from .unknown import Unknowns

# Signals that differ by less than this, twice the log-likelihood that the right one is expected to gain, are one.
SAME = 6.0
# What any motion leaves of a cause's signal, as a share of its chi-square, when a rival that no motion tells from it is
# in its place: the rest of linear steps.
_SAME_SHARE = 1e-3
# A rival less probable than this is none.
PROBABLE = 0.02
# What explains a smaller share of what a cause explains is none either.
_COMES_NEAR = 0.7
# What is so much less probable is not fitted to the end [nats].
_HOPELESS = 40.0
_Other = tuple[Fit | Nameless, Effect | None, str]
# Poses of the motion over the whole range of the joints, which stands for any motion, and by how much the logarithms
# of the times between them scatter there.
_POSES, _UNEVEN = 400, 1.0


@dataclass(frozen=True, eq=False)
class Rival:
    """What could be there in the place of a cause.

    Attributes:
        instead: the causes with it in the place of the cause.
        effect: with the numbers with which it does best; None where it has no name.
        described: in a few words.
        probability: given that one of the rivals is there.
        difference: twice the log-likelihood that this motion is expected to tell them apart by.
        anywhere: the same for as many poses over the whole range of the joints.
        signal: what the cause itself brings there.
        is_one: whether the cause, refitted, is also all that this is on any motion, so that both are one.
    """

    instead: Fit | Nameless
    effect: Effect | None
    described: str
    probability: float
    difference: float
    anywhere: float
    signal: float
    is_one: bool

    @property
    def is_same_here(self) -> bool:
        """Whether no data of this motion tells it from the cause."""
        return self.difference < SAME

    @property
    def is_same_anywhere(self) -> bool:
        """Whether no motion does."""
        return self.anywhere < _SAME_SHARE * self.signal


@dataclass(frozen=True, eq=False)
class Standing:
    """How one cause stands against all others.

    Attributes:
        itself: the cause as it would explain most there.
        probability: of the cause, or of what is one with it.
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


def standings(fit: Fit, search: Search, blocks: Blocks, seed: int, unknowns: Unknowns | None = None) -> list[Standing]:
    """One for each cause of a fit.

    Args:
        unknowns: what has no name and may be a cause as well.
    """
    return [_standing(fit, cause, search, blocks, seed, unknowns) for cause in fit.causes]


def _standing(
    fit: Fit, cause: Effect, search: Search, blocks: Blocks, seed: int, unknowns: Unknowns | None
) -> Standing:
    beside = search.beside(fit, cause)
    without = beside.without
    gain = 2.0 * (fit.log_likelihood - without.log_likelihood)
    itself = beside.itself
    worth = nats(gain, itself.dof) - search.doubt(itself)
    if remembers(cause):
        worth = min(worth, search.agreed(without, itself))
    nothing = Instead(without, -itself.dof, -search.doubt(itself))
    tried = []
    for candidate in beside.candidates:
        if candidate.gain < _COMES_NEAR * itself.gain:
            continue
        rival = beside.exchanged(candidate, fit.log_likelihood - _HOPELESS)
        doubt = float(np.log(max(candidate.trials / max(itself.trials, 1), 1e-3)))
        tried.append((Instead(rival, candidate.dof - itself.dof, doubt), candidate.effect))
    behind = [nats(2.0 * (one.fit.log_likelihood - fit.log_likelihood), one.dof) - one.doubt for one, _ in tried]
    others: list[_Other] = [_as_fitted(one.fit, effect) for one, effect in tried]
    if unknowns is not None:
        near = unknowns.specific(without, _COMES_NEAR * itself.gain)
        aparts = [unknowns.apart(without, (way,)) for way in near]
        if (nameless := Nameless.in_place_of(cause, fit, aparts, unknowns, search)) is not None:
            others.append((nameless, None, nameless.what))
            behind.append(nameless.behind)
    odds = np.exp(np.clip([0.0, -worth, *behind], -500.0, 50.0))
    shares = odds / odds.sum()
    wide = widened(fit, range(fit.observations.motion.q.shape[1]), uneven=_UNEVEN)
    signal = apart_on(fit, without, wide)
    rivals = []
    for (other, effect, told), share in zip(others, shares[2:], strict=True):
        if share >= PROBABLE:
            anywhere = apart_on(fit, other, wide)
            one = anywhere < _SAME_SHARE * signal and _is_no_more(other, fit, without, wide)
            rivals.append(Rival(other, effect, told, float(share), _difference(fit, other), anywhere, signal, one))
    same = sum(rival.probability for rival in rivals if rival.is_one)
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


def _is_no_more(other: Fit | Nameless, fit: Fit, without: Fit, wide: Motion) -> bool:
    """Whether the cause of a fit, refitted, is all that a rival is on any motion: one of more numbers may be more."""
    if not isinstance(other, Fit):
        return True
    return apart_on(other, fit, wide) < _SAME_SHARE * apart_on(other, without, wide)


def _as_fitted(fit: Fit, effect: Effect) -> _Other:
    cause = next(cause for cause in fit.causes if cause.identity == effect.identity)
    return fit, cause, describe(cause)


def _difference(one: Fit, other: Fit | Nameless) -> float:
    """Twice the log-likelihood by which the predictions of two fits differ over their observations."""
    predicted = other.predicted
    apart = one.observations.whitened((one.predicted - predicted)[:, :, None])[:, :, 0]
    return float((one.noise.weights[:, None] * np.square(apart)).sum() / one.noise.sigma**2)


def widened(fit: Fit, joints: Iterable[int], uneven: float = 0.0) -> Motion:
    """Some rows of a fit's motion over the same time, with some joints anywhere in their range, in runs of two.

    Args:
        uneven: by how much the logarithms of the times between rows scatter.
    """
    motion = fit.observations.motion
    rng = np.random.default_rng(0)
    n = len(motion)
    rows = np.sort(rng.integers(n, size=min(n, _POSES)))
    q = motion.q[rows].copy()
    for k in joints:
        q[:, k] = rng.uniform(*whole_range(fit, k), len(rows))
    clock = motion.clock
    gaps = np.cumsum(np.exp(uneven * rng.normal(size=len(rows))))
    shares = (gaps - gaps[0]) / max(gaps[-1] - gaps[0], 1e-9)
    return Motion(q, clock[0] + shares * (clock[-1] - clock[0]), np.arange(len(rows)) // 2)


def whole_range(fit: Fit, joint: int) -> tuple[float, float]:
    """Return where a joint can be moved [rad, m]: a turn at most; a slide three times as far as in the recording."""
    robot, q = fit.simulation.robot, fit.observations.motion.q[:, joint]
    low, high, reach = float(robot.lower[joint]), float(robot.upper[joint]), float(np.ptp(q))
    if not robot.chain.prismatic[joint]:
        return max(low, -np.pi), min(high, np.pi)
    return max(low, float(q.min()) - reach), min(high, float(q.max()) + reach)


def apart_on(one: Fit, other: Fit | Nameless, motion: Motion) -> float:
    """Twice the log-likelihood by which two fits differ on a motion as long as theirs, the other refitted to it."""
    there = other.simulation.positions(motion) if isinstance(other, Fit) else other.positions(motion)
    left = _beside(one.simulation.positions(motion) - there, _columns(other, motion))
    scale = float(np.median(np.linalg.det(one.observations.whitening))) ** (1.0 / 3.0)
    share = len(one.observations) / len(motion)
    return float(np.square(left * scale).sum() / one.noise.sigma**2 * share)


def _columns(fit: Fit | Nameless, motion: Motion) -> FloatArray:
    """Derivatives (n, 3, p) [m] of what is measured on a motion by the amounts of a fit."""
    if isinstance(fit, Nameless):
        return fit.columns(motion)
    return amount_columns(fit.simulation.run(motion), fit.simulation.effects)


def _beside(apart: FloatArray, columns: FloatArray) -> FloatArray:
    """What of `apart` (n, 3) columns (n, 3, p) cannot follow."""
    flat = columns.reshape(apart.size, -1)
    scales = np.linalg.norm(flat, axis=0)
    flat = flat / np.where(scales > 0.0, scales, 1.0)
    solved = np.linalg.lstsq(flat, apart.ravel(), rcond=1e-9)[0]
    return (apart.ravel() - flat @ solved).reshape(apart.shape)
