"""Estimate the probability of each cause against its rivals, which this motion, another one, or none can separate."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyschema.diagnosis.fit.fit import Fit, amount_columns, solved
from bodyschema.diagnosis.fit.net_evidence import WorthSettings
from bodyschema.diagnosis.fit.scatter import beyond_single_rows, limited_rows, remembers
from bodyschema.diagnosis.fit.tangent import TangentSettings
from bodyschema.diagnosis.search.held_out import Blocks, orthogonal_to_fit
from bodyschema.diagnosis.search.scan import Candidate
from bodyschema.diagnosis.search.search import Search
from bodyschema.diagnosis.unnamed.family_fits import UnnamedFamilies
from bodyschema.effects import Effect, EffectType, Motion
from bodyschema.effects.encoder import EncoderEffect
from bodyschema.interfaces.records import FloatArray

from .unnamed_alternative import UnnamedAlternative


class RivalSettings:
    """Settings of rivals.

    Sensitivity, each at 0.3 and 3 times over three recordings with hidden errors: `comes_near` changes who is a rival,
    and with it probabilities; `bagged` a probability by up to 0.03; `poses` a word of advice. The rest changes none.
    """

    same_share = 1e-3  # predictions are the same if their expected Δχ² is smaller
    bagged = 400  # number of resamplings for probabilities; 0.3 to 3 times this changes them by less than 0.03
    comes_near = 0.7  # smallest share of a cause's gain that a rival must explain
    hopeless = 40.0  # a rival less probable by this is not fitted to convergence [nats]
    # Number of poses over the whole range of the joints, which stand for any motion, and the scatter of the logarithms
    # of the times between them.
    poses, uneven = 400, 1.0
    next_to_it = 1e-3  # smallest move there, as a share of a far one
    probable = 0.02  # a less probable rival is not listed


@dataclass(frozen=True, eq=False)
class Alternative:
    """An alternative to a cause."""

    fit_with_it: Fit | UnnamedAlternative  # the fit with it in the place of the cause
    hypothesis: Effect | UnnamedAlternative  # the effect with its best-fitting numbers, or the unnamed alternative
    probability: float  # given that the cause or one of its rivals is present
    separation_here: float  # Δχ² by which this motion is expected to separate them
    separation_anywhere: float  # the same for as many poses over the whole range of the joints
    signal: float  # Δχ² of the cause itself on those poses
    # True if the refitted cause also covers this rival on any motion, so that either may be corrected
    is_equivalent: bool

    @property
    def is_same_here(self) -> bool:
        """True if no data of this motion separates it from the cause."""
        return self.separation_here < WorthSettings.same

    @property
    def is_same_anywhere(self) -> bool:
        """True if no motion separates it from the cause."""
        return self.separation_anywhere < RivalSettings.same_share * self.signal


@dataclass(frozen=True, eq=False)
class CauseAssessment:
    """Assessment of one cause against all rivals."""

    hypothesis: Candidate  # the cause with its best first-order fit
    probability: float  # probability of the cause or its equivalents
    dof: int  # number of its amounts that the data determine
    gain: float  # its Δχ²
    rivals: tuple[Alternative, ...]  # the probable ones, the most probable first
    # True if a joint that deflects under the arm's weight explains nearly as much, and was not tested, or only with
    # assumed weights
    is_like_sag: bool = False


def assessments(
    fit: Fit, search: Search, blocks: Blocks, seed: int, unnamed: UnnamedFamilies | None = None
) -> list[CauseAssessment]:
    """Assess each cause of a fit."""
    return [_assess(fit, cause, search, blocks, seed, unnamed) for cause in fit.causes]


def _assess(
    fit: Fit, cause: Effect, search: Search, blocks: Blocks, seed: int, unnamed: UnnamedFamilies | None
) -> CauseAssessment:
    leave_one_out = search.leave_one_out(fit, cause)
    without = leave_one_out.without
    gain = 2.0 * (fit.log_likelihood - without.log_likelihood)
    hypothesis, net_evidence = leave_one_out.hypothesis, search.net_evidence(fit, cause)
    tried: list[tuple[Fit, Effect]] = []
    relative_evidence = list[float]()
    for candidate in leave_one_out.candidates:
        if candidate.gain < RivalSettings.comes_near * hypothesis.gain:
            continue
        rival = leave_one_out.exchange(candidate, fit.log_likelihood - RivalSettings.hopeless)
        multiplicity_penalty = float(np.log(max(candidate.trials / max(hypothesis.trials, 1), 1e-3)))
        if can_be_measured(cause, candidate.effect) and _difference(fit, rival) < WorthSettings.same:
            # It is not by chance that one number of a link among many equals a scale's effect.
            multiplicity_penalty = 0.0
        evidence = rival.log_likelihood - fit.log_likelihood - leave_one_out.cost_of(candidate) - multiplicity_penalty
        evidence += search.joint_offset_preference(fit, hypothesis, candidate)
        both_remember = remembers(cause) and remembers(candidate.effect)
        tried.append((rival, candidate.effect))
        relative_evidence.append(evidence + (beyond_single_rows(fit, rival) if both_remember else 0.0))
    others: list[tuple[Fit | UnnamedAlternative, Effect | UnnamedAlternative]] = [_as_fitted(*one) for one in tried]
    if unnamed is not None:
        near = unnamed.specific(without, RivalSettings.comes_near * hypothesis.gain)
        discrepancy_fits = [unnamed.discrepancy_fit(without, (prepared,)) for prepared in near]
        if (alternative := UnnamedAlternative.in_place_of(cause, fit, discrepancy_fits, unnamed, search)) is not None:
            others.append((alternative, alternative))
            relative_evidence.append(alternative.relative_evidence)
    # The worth of a cause accounts for blocks already.
    rows = [
        np.zeros(len(fit.weighted_residuals)),
        *(_evidence_by_row(fit, other, cause, hypothesis) for other, hypothesis in others),
    ]
    probable = bagged([-net_evidence, *relative_evidence], rows, blocks, seed)
    wide = wide_motion(fit, range(fit.observations.motion.q.shape[1]), uneven=RivalSettings.uneven)
    signal = expected_separation(fit, without, wide)
    rivals = []
    for (other, alternative), share in zip(others, probable[2:], strict=True):
        if share >= RivalSettings.probable:
            separation_anywhere = expected_separation(fit, other, wide)
            one = separation_anywhere < RivalSettings.same_share * signal and _is_covered(other, fit, without, wide)
            one = one and not can_be_measured(cause, alternative)
            rivals.append(
                Alternative(other, alternative, float(share), _difference(fit, other), separation_anywhere, signal, one)
            )
    same = sum(rival.probability for rival in rivals if rival.is_equivalent)
    ordered = tuple(sorted(rivals, key=lambda rival: rival.probability, reverse=True))
    sags = is_like_sag(without, cause, RivalSettings.comes_near * hypothesis.gain)
    return CauseAssessment(hypothesis, float(probable[0]) + same, hypothesis.dof, gain, ordered, sags)


def can_be_measured(cause: Effect, rival: Effect | UnnamedAlternative) -> bool:
    """Return True if a ruler separates a cause from its rival: a wrong scale of everything from a wrong arm length."""
    return isinstance(rival, Effect) and cause.kind.scales_all != rival.kind.scales_all


def resembles_sag(kind: EffectType) -> bool:
    """Return True for a joint error that depends on angles alone, as sag nearly does."""
    lasts = not (kind.depends_on_path or kind.changes_with_time)
    return isinstance(kind, EncoderEffect) and lasts and not kind.is_zero


def is_like_sag(without: Fit, cause: Effect, least: float) -> bool:
    """Return True if a spring at one joint explains a cause, and the weight is assumed or not borne by the joints.

    Args:
        without: the fit without the cause.
        least: the Δχ² that it has to explain, to first order.
    """
    run = without.run
    if (run.simulation.bears_weight and run.simulation.gravity.known) or not resembles_sag(cause.kind):
        return False
    columns = without.weighted(run.by_joint * run.torques[:, None, :])
    orthogonal = orthogonal_to_fit(without, columns).reshape(without.weighted_residuals.size, -1)
    left = without.whitened_residuals.ravel()
    rhs, squares = orthogonal.T @ left, np.square(orthogonal).sum(axis=0)
    # The share of a column beyond the fit's own parameters may be rounding alone.
    identifiable = (rhs > 0.0) & (squares > TangentSettings.told_apart * np.square(columns).sum(axis=(0, 1)))
    explained = np.square(rhs[identifiable]) / squares[identifiable]
    rows = 3.0 * float(without.noise.weights.sum())
    share = float(explained.max(initial=0.0)) / max(float(left @ left), 1e-300)
    return bool(-rows * np.log1p(-min(share, 1.0 - 1e-9)) >= least)


def bagged(relative_evidence: Sequence[float], rows: Sequence[FloatArray], blocks: Blocks, seed: int) -> FloatArray:
    """Return the probability of a cause and of each alternative to it (1 + m,), as the mean over block resamplings.

    No model is exact, so evidence that depends on a few blocks is uncertain (Huggins and Miller 2023, bagged
    posteriors).

    Args:
        relative_evidence: log-evidence of each alternative over the cause [nats].
        rows: contribution of each row to it (n,).
    """
    even = np.full(blocks.count, 1.0 / blocks.count)
    drawn = np.random.default_rng(seed).multinomial(blocks.count, even, RivalSettings.bagged) - 1
    log_odds = np.array(
        [
            np.zeros(RivalSettings.bagged),
            *(b + drawn @ blocks.sums(own) for b, own in zip(relative_evidence, rows, strict=True)),
        ]
    )
    odds = np.exp(log_odds - log_odds.max(axis=0))
    return np.asarray((odds / odds.sum(axis=0)).mean(axis=1), dtype=np.float64)


def _evidence_by_row(
    fit: Fit, other: Fit | UnnamedAlternative, cause: Effect, hypothesis: Effect | UnnamedAlternative
) -> FloatArray:
    """Return the log-likelihood of an alternative over a fit at each row (n,) [nats]."""
    there = other if isinstance(other, Fit) else other.discrepancy_fit.fit
    if isinstance(hypothesis, Effect) and remembers(cause) and remembers(hypothesis):
        return limited_rows(fit, there)
    return there.row_log_likelihoods - fit.row_log_likelihoods


def _is_covered(other: Fit | UnnamedAlternative, fit: Fit, without: Fit, wide: Motion) -> bool:
    """Return True if the refitted cause covers everything that a rival can do on any motion."""
    if not isinstance(other, Fit):
        return True
    return expected_separation(other, fit, wide) < RivalSettings.same_share * expected_separation(other, without, wide)


def _as_fitted(fit: Fit, effect: Effect) -> tuple[Fit, Effect]:
    return fit, next(cause for cause in fit.causes if cause.identity == effect.identity)


def _difference(one: Fit, other: Fit | UnnamedAlternative) -> float:
    """Return the Δχ² by which the predictions of two fits differ over their observations."""
    predicted = other.predicted
    difference = one.observations.whitened((one.predicted - predicted)[:, :, None])[:, :, 0]
    return float((one.noise.weights[:, None] * np.square(difference)).sum() / one.noise.sigma**2)


def wide_motion(fit: Fit, joints: Iterable[int], uneven: float = 0.0) -> Motion:
    """Return some rows of a fit's motion in runs of two, with some joints anywhere in their range.

    Args:
        uneven: scatter of the logarithms of the times between rows.
    """
    motion = fit.observations.motion
    rng = np.random.default_rng(0)
    n = len(motion)
    rows = np.sort(rng.integers(n, size=min(n, RivalSettings.poses)))
    q = motion.q[rows].copy()
    for k in joints:
        q[:, k] = rng.uniform(*whole_range(fit, k), len(rows))
        # The second pose of each run is near to far from the first, which separates effects with memory.
        firsts, seconds = q[: len(rows) // 2 * 2 : 2, k], q[1::2, k]
        reach = np.exp(rng.uniform(np.log(RivalSettings.next_to_it), 0.0, len(seconds)))
        seconds[:] = firsts + reach * (seconds - firsts)
    clock = motion.clock
    gaps = np.cumsum(np.exp(uneven * rng.normal(size=len(rows))))
    shares = (gaps - gaps[0]) / max(gaps[-1] - gaps[0], 1e-9)
    return Motion(q, clock[0] + shares * (clock[-1] - clock[0]), np.arange(len(rows)) // 2)


def whole_range(fit: Fit, joint: int) -> tuple[float, float]:
    """Return the range of a joint [rad, m]: at most a turn; for a prismatic joint, three times the recorded range."""
    robot, q = fit.simulation.robot, fit.observations.motion.q[:, joint]
    low, high, reach = float(robot.lower[joint]), float(robot.upper[joint]), float(np.ptp(q))
    if not robot.chain.prismatic[joint]:
        return max(low, -np.pi), min(high, np.pi)
    return max(low, float(q.min()) - reach), min(high, float(q.max()) + reach)


def expected_separation(one: Fit, other: Fit | UnnamedAlternative, motion: Motion) -> float:
    """Return the Δχ² by which two fits differ on a motion as long as theirs, the other refitted to it."""
    there = other.simulation.positions(motion) if isinstance(other, Fit) else other.positions(motion)
    difference = one.simulation.positions(motion) - there
    flat = _columns(other, motion).reshape(difference.size, -1)
    left = difference - (flat @ solved(flat.T @ flat, flat.T @ difference.ravel())).reshape(difference.shape)
    scale = float(np.median(np.linalg.det(one.observations.whitening))) ** (1.0 / 3.0)
    share = len(one.observations) / len(motion)
    return float(np.square(left * scale).sum() / one.noise.sigma**2 * share)


def _columns(fit: Fit | UnnamedAlternative, motion: Motion) -> FloatArray:
    """Return derivatives (n, 3, p) [m] of predictions on a motion by the amounts of a fit."""
    if isinstance(fit, UnnamedAlternative):
        return fit.columns(motion)
    return amount_columns(fit.simulation.run(motion), fit.simulation.effects)
