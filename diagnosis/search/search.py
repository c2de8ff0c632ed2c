"""Search for the causes: add them one by one, remove redundant ones, and exchange causes for rivals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from bodyschema.diagnosis.fit.fit import Fit, amount_columns, improved, solved
from bodyschema.diagnosis.fit.net_evidence import (
    WorthSettings,
    choice_count,
    evidence_gain,
    parameter_cost,
    required_rise,
)
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.fit.scatter import beyond_single_rows, instruments, remembers
from bodyschema.effects import Effect, Identity

from .held_out import Blocks, block_p_value
from .hypotheses import has_simpler_name
from .scan import Candidate, Scan, refit_moment


class _Settings:
    """Settings of the search.

    Sensitivity, each at 0.3 and 3 times over seven recordings with hidden errors: with `near` or `comes_near` above 1,
    and with fewer candidates (`most`), other rivals are tried, and five, four and three reports differ. The others
    change nothing there: no search is long, and no cause begins at more than three moments.
    """

    near, most = 0.4, 6  # candidates within this share of the best gain are refitted, up to this number
    worth_in_full = 0.2  # candidates within this share of the best gain are evaluated beyond first order
    # With more causes than this, the error has been described and not explained; maximum of steps of the search.
    max_causes, max_steps = 12, 20
    max_moments = 3  # more jumps, slips and bumps than this in one recording describe something that comes and goes
    max_sets = 60  # maximum of sets of causes to examine; none is examined twice
    # Multiple of a limit, and the margin to it [nats], beyond which the first order decides.
    # With 0.3 to 3 times these, three recordings had the same causes, probabilities to 0.001 and RMS to 0.01 %.
    clearly, at_least = 2.0, 10.0
    # A rival must explain this share of a cause's gain; differences within this count as equal [nats].
    comes_near, equal = 0.8, 0.3
    # Largest part of the evidence between two memory effects of a joint that may lie in a few rows [nats].
    of_single_rows = 10.0
    better_moment = 1.0  # a moment or a period that promises this much more than the fitted one is tried
    # As many rows beside a moment may be on its wrong side and seem to be outliers (more are a change, as the noise has
    # it), where the weight of some is smaller than this.
    near_a_moment, off = 27, 0.5
    astray = 5.0  # a period that explains less than before by this has diverged [nats]
    # With fewer blocks of time, p-values are too coarse; a gain above this needs no p-value [nats].
    few_blocks, beyond_doubt = 20, 30.0
    of_a_link = 1  # the camera's pose and the marker's position are simpler than the adjacent link


Key = tuple[str, str | None, str | None]
Named = frozenset[tuple[Key, int]]


class LeaveOneOut:
    """A fit without one of its causes, with the candidates to replace it.

    Attributes:
        others: the other causes.
        hypothesis: the cause with its best first-order fit.
        gain: its present first-order gain, Δχ².
        in_parts: the cause with the best choice of its amounts; None if there is no choice.
        candidates: hypotheses that are not yet causes, the most probable first.
    """

    def __init__(
        self,
        fit: Fit,
        cause: Effect,
        hypothesis: Candidate | None,
        gain: float,
        in_parts: Candidate | None,
        candidates: list[Candidate],
    ) -> None:
        self._fit, self._cause = fit, cause
        self.others = [effect for effect in fit.causes if effect is not cause]
        self._tried: dict[Identity, Fit] = {}
        self.hypothesis = hypothesis or Candidate(cause, 0.0, 1)
        self.gain, self.in_parts, self.candidates = gain, in_parts, candidates

    @cached_property
    def without(self) -> Fit:
        """Return the fit without the cause.

        Another cause that begins nearby may have left rows to this one, and gets another moment without it.
        """
        fit = improved(self._fit.with_unfitted_causes(self.others))
        if not self._cause.kind.begins:
            return fit
        for k in range(len(fit.causes)):
            other = fit.causes[k]
            again = refit_moment(fit, other, _rows_near_moment(fit, other)) if other.kind.begins else None
            if again is not None:
                moved = fit.with_unfitted_causes([*fit.causes[:k], again.effect, *fit.causes[k + 1 :]])
                fit = max(fit, improved(moved), key=lambda one: one.log_likelihood)
        return fit

    @property
    def lead(self) -> float:
        """First-order lead of the cause over the best candidate to replace it [nats]."""
        return 0.5 * (self.hypothesis.gain - max((one.gain for one in self.candidates), default=0.0))

    def cost_of(self, candidate: Candidate) -> float:
        """Return the cost of a candidate's numbers beyond those of the cause [nats].

        Each number of an effect is known to a small fraction of the effect's size, so that the simpler effect is
        favoured by more than the number of its parameters.
        """
        return parameter_cost(candidate.gain, candidate.dof) - parameter_cost(self.hypothesis.gain, self.hypothesis.dof)

    def is_worth_less_than(self, net_evidence: float) -> bool:
        """Return True if the cause has less than this net evidence [nats]."""
        rise = required_rise(net_evidence, self.hypothesis.dof)
        threshold = self._fit.log_likelihood - rise
        if self._cause.kind.begins and any(one.kind.begins for one in self.others):
            return self.without.log_likelihood > threshold
        if self._fit.loss(self._cause) > _Settings.clearly * rise + _Settings.at_least:
            return False
        return improved(self._fit.with_unfitted_causes(self.others), threshold).log_likelihood > threshold

    def better_moment(self) -> Fit | None:
        """Refit with a better moment or period of the cause, or None."""
        fit, cause = self._fit, self._cause
        threshold = fit.log_likelihood + _Settings.better_moment
        tried = [self.hypothesis] if self.hypothesis.gain > self.gain + _Settings.better_moment else []
        if cause.kind.begins:
            near = _rows_near_moment(fit, cause)
            if (fit.noise.weights[near & fit.observations.trusted] < _Settings.off).any():
                tried += [again for again in [refit_moment(fit, cause, near)] if again is not None]
        for candidate in tried:
            there = improved(fit.with_unfitted_causes([*self.others, candidate.effect]), threshold)
            if there.log_likelihood > threshold:
                return there
        return None

    def exchange(self, candidate: Candidate, threshold: float) -> Fit:
        """Refit with a candidate instead of the cause; the best such fit is kept."""
        effect = candidate.effect
        known = self._tried.get(effect.identity)
        if known is None or known.log_likelihood < threshold:
            expected = self._fit.log_likelihood + 0.5 * (candidate.gain - self.hypothesis.gain)
            start = known or self._fit.with_unfitted_causes([*self.others, effect])
            known = self._tried[effect.identity] = refit_with_cause(start, effect, threshold, expected)
        return known


class Search:
    """Greedy search with backtracking.

    Args:
        hypotheses: the possible causes.
        tell: called with short messages on progress.
    """

    def __init__(self, hypotheses: Sequence[Effect], tell: Callable[[str], None]) -> None:
        self._hypotheses, self._tell = hypotheses, tell
        self.multiplicity = float(np.log(max(len(hypotheses), 1)))  # penalty for the number of hypotheses [nats]
        self._trials: dict[Key, float] = {}
        self._known: tuple[Fit | None, Scan | None, dict[Identity, LeaveOneOut]] = (None, None, {})
        # Lead of each cause when it was last reviewed, the log-likelihood then, and the observations [nats].
        self._leads: dict[Identity, tuple[float, float, Observations]] = {}
        self.path: list[Fit] = []
        self.ended_early = False

    def run(self, start: Fit) -> Fit:
        """Find the causes in addition to the parameters that `start` has fitted.

        Afterwards `ended_early` is True if the number of steps ended the search before it converged.
        """
        fit, self.ended_early = start, False
        self._seen: set[Named] = set()
        self.path = [start]
        if start.causes:
            fit = self._review(start)
            self._append_to_path(fit)
        while (
            len(self.path) <= _Settings.max_steps
            and len(fit.causes) <= _Settings.max_causes
            and len(self._seen) < _Settings.max_sets
        ):
            added = self._add_cause(fit)
            if added is None or (causes := cause_counts(added.causes)) in self._seen:
                break
            self._tell(f"found {describe(added.causes[-1])}")
            self._seen.add(causes)
            fit = self._review(added)
            self._append_to_path(fit)
        is_long = len(self.path) > _Settings.max_steps or len(self._seen) >= _Settings.max_sets
        self.ended_early = is_long or len(fit.causes) > _Settings.max_causes
        return fit

    def _append_to_path(self, fit: Fit) -> None:
        """Append a fit to the path; the one before drops its cached results, which are large for many rows."""
        self.path[-1] = replace(self.path[-1])
        self.path.append(fit)

    def _add_cause(self, fit: Fit) -> Fit | None:
        """Add one more cause; None if no candidate is probable enough."""
        best, most = None, WorthSettings.named_nats
        known = self._known[1] if self._known[0] is fit else None
        eligible = [
            one for one in self._open_hypotheses(fit) if not has_simpler_name(one, self._hypotheses, fit.simulation)
        ]
        for candidate in self.shortlist(known or Scan(fit), eligible):
            if self.evidence_from_blocks(fit, candidate) < WorthSettings.named_nats:
                continue
            multiplicity_penalty = self.multiplicity_penalty(candidate, fit.causes)
            threshold = fit.log_likelihood + required_rise(most + multiplicity_penalty, candidate.dof)
            start = fit.with_unfitted_causes([*fit.causes, candidate.effect])
            tried = refit_with_cause(start, candidate.effect, threshold, fit.log_likelihood + 0.5 * candidate.gain)
            gain = 2.0 * (tried.log_likelihood - fit.log_likelihood) * self._independent_share(tried, candidate.effect)
            net_evidence = evidence_gain(gain, candidate.dof) - multiplicity_penalty
            if net_evidence > most and tried.causes[-1].is_valid:
                best, most = tried, net_evidence
        return best

    def _exchange(
        self, fit: Fit, leave_one_out: LeaveOneOut, candidate: Candidate, threshold: float
    ) -> tuple[Fit, float]:
        """Exchange a cause for a candidate, and return the evidence gain [nats]; approximate if below `threshold`."""
        costs = leave_one_out.cost_of(candidate)
        penalty_difference = self.multiplicity_penalty(
            leave_one_out.hypothesis, leave_one_out.others
        ) - self.multiplicity_penalty(candidate, leave_one_out.others)
        penalty_difference += self.joint_offset_preference(fit, leave_one_out.hypothesis, candidate)
        both_remember = remembers(leave_one_out.hypothesis.effect) and remembers(candidate.effect)
        threshold -= _Settings.of_single_rows if both_remember else 0.0
        tried = leave_one_out.exchange(candidate, fit.log_likelihood + threshold - penalty_difference + costs)
        net_evidence = tried.log_likelihood - fit.log_likelihood - costs + penalty_difference
        return tried, net_evidence + (beyond_single_rows(fit, tried) if both_remember else 0.0)

    def joint_offset_preference(self, fit: Fit, cause: Candidate, other: Candidate) -> float:
        """Return the bonus for `other` instead of a cause if one is a joint offset that the other contains [nats].

        A link rotated about its joint's axis, or about the previous one, is that joint's offset. Its further numbers
        must be worth a name in addition to the offset.
        """
        if contains(fit, cause.effect, other.effect):
            return WorthSettings.named_nats + self.multiplicity_penalty(other)
        return (
            -WorthSettings.named_nats - self.multiplicity_penalty(cause)
            if contains(fit, other.effect, cause.effect)
            else 0.0
        )

    def _open_hypotheses(self, fit: Fit) -> list[Effect]:
        """Return the hypotheses that are not causes of a fit, with one more of each that begins at a moment."""
        present = Counter(effect.key for effect in fit.causes)
        taken = {effect.identity for effect in fit.causes}
        others = []
        for effect in self._hypotheses:
            count = present[effect.key]
            if count == 0:
                others.append(effect)
            elif count < effect.kind.most_at_one_place:
                more = (effect.with_ordinal(ordinal) for ordinal in range(count + 1))
                others.append(next(one for one in more if one.identity not in taken))
        return others

    def multiplicity_penalty(self, candidate: Candidate, other_causes: Iterable[Effect] = ()) -> float:
        """Return the multiplicity penalty for the number of places searched, beside other causes [nats]."""
        self._trials[candidate.effect.key] = candidate.trials
        others = list(other_causes)
        zeros = [cause for cause in others if cause.kind.is_zero]
        # All joint offsets together count as one name.
        first = self.multiplicity - float(np.log(1 + len(others) - max(len(zeros) - 1, 0)))
        is_another = candidate.effect.kind.is_zero and any(one.kind.is_zero for one in others)
        return (min(first, WorthSettings.another_nats) if is_another else first) + float(np.log(candidate.trials))

    def multiplicity_penalty_of(self, effect: Effect) -> float:
        """Return the multiplicity penalty of an effect that was a candidate [nats]."""
        trials = choice_count(effect) if effect.kind.in_parts else self._trials.get(effect.key, 1)
        return float(self.multiplicity + np.log(trials))

    def net_evidence(self, fit: Fit, cause: Effect) -> float:
        """Return the evidence gain of a cause of a fit over leaving it out [nats]."""
        leave_one_out = self.leave_one_out(fit, cause)
        gain = 2.0 * (fit.log_likelihood - leave_one_out.without.log_likelihood)
        net_evidence = evidence_gain(gain, leave_one_out.hypothesis.dof) - self.multiplicity_penalty(
            leave_one_out.hypothesis, leave_one_out.others
        )
        return (
            min(net_evidence, self.evidence_from_blocks(leave_one_out.without, leave_one_out.hypothesis))
            if remembers(cause)
            else net_evidence
        )

    def evidence_from_blocks(self, fit: Fit, candidate: Candidate) -> float:
        """Return a candidate's worth by the agreement of blocks of time, which may be correlated inside [nats]."""
        effect, blocks = candidate.effect, Blocks.cut(len(fit.observations))
        columns = instruments(fit, effect)
        chance = block_p_value(fit, columns, blocks)
        gain = float(chdtri(candidate.dof, max(chance, 1e-290)))
        multiplicity_penalty = self.multiplicity_penalty(candidate, fit.causes)
        net_evidence = evidence_gain(gain, candidate.dof) - multiplicity_penalty
        if blocks.count < _Settings.few_blocks and net_evidence < WorthSettings.named_nats:
            # Few blocks cannot give a small p-value; a large gain counts without them.
            plain = evidence_gain(fit.independence * candidate.gain, candidate.dof) - multiplicity_penalty
            net_evidence = max(net_evidence, plain) if plain > _Settings.beyond_doubt else net_evidence
        return net_evidence

    def _independent_share(self, fit: Fit, effect: Effect) -> float:
        """Return the share of a gain that counts: correlated noise looks like a change with time."""
        return fit.independence if effect.kind.changes_with_time else 1.0

    def shortlist(self, scan: Scan, hypotheses: Sequence[Effect]) -> list[Candidate]:
        """Return the candidates that may be best after a refit, the most probable first."""
        scanned = [
            one for one in scan.candidates(hypotheses, _Settings.near) if not scan.is_within_tolerance(one.effect)
        ]
        most = max((one.gain for one in scanned), default=0.0)
        scanned = [
            scan.beyond_first_order(one) if one.gain >= _Settings.worth_in_full * most else one for one in scanned
        ]
        ranked = sorted(
            scanned, key=lambda c: evidence_gain(c.gain, c.dof) - self.multiplicity_penalty(c), reverse=True
        )
        if not ranked:
            return []
        floor = _Settings.near * ranked[0].gain
        return [c for c in ranked[: 3 * _Settings.most] if c.gain >= floor][: _Settings.most]

    def _review(self, fit: Fit) -> Fit:
        """Review one cause after another, until each was reviewed after the last change that may concern it."""
        waiting = [cause.identity for cause in fit.causes]
        while waiting and len(self._seen) < _Settings.max_sets:
            cause = next(effect for effect in fit.causes if effect.identity == waiting[0])
            better = None if self._has_clear_lead(fit, cause) else self._reconsider(fit, cause)
            later = waiting[1:]
            if better is None:
                waiting = later
                continue
            causes = cause_counts(better.causes)
            is_seen = causes in self._seen and causes != cause_counts(fit.causes)
            fit = better
            if is_seen:
                break
            self._seen.add(causes)
            there = [effect.identity for effect in fit.causes]
            waiting = [one for one in later if one in there] + [one for one in there if one not in later]
        return fit

    def _has_clear_lead(self, fit: Fit, cause: Effect) -> bool:
        """Return True if a cause's lead at its last review exceeds the change of the fit since then.

        Causes that begin at a moment or have a choice of numbers are never clear: another choice may be better.
        """
        if cause.kind.begins or cause.kind.in_parts or cause.identity not in self._leads:
            return False
        lead, then, observations = self._leads[cause.identity]
        changed = abs(fit.log_likelihood - then)
        return observations is fit.observations and lead > _Settings.clearly * changed + _Settings.at_least

    def _scan(self, fit: Fit) -> Scan:
        """Return the scan of a fit and of the fit without each of its causes; the last one is kept."""
        known, scan, _ = self._known
        if known is not fit or scan is None:
            scan = Scan(fit, fit.causes)
            self._known = (fit, scan, {})
        return scan

    def leave_one_out(self, fit: Fit, cause: Effect) -> LeaveOneOut:
        """Return the fit without a cause and the candidates for its place."""
        scan, known = self._scan(fit).without(cause), self._known[2]
        if cause.identity not in known:
            rivals = [effect for effect in self._open_hypotheses(fit) if effect.key != cause.key]
            hypothesis, candidates = scan.candidate(cause), self.shortlist(scan, rivals)
            in_parts = scan.candidate(cause.with_free_amounts(None)) if cause.kind.in_parts else None
            known[cause.identity] = LeaveOneOut(fit, cause, hypothesis, scan.present_gain(cause), in_parts, candidates)
        return known[cause.identity]

    def _reconsider(self, fit: Fit, cause: Effect) -> Fit | None:
        """Return the fit with a cause refined, dropped or exchanged; None if it stays unchanged."""
        leave_one_out = self.leave_one_out(fit, cause)
        if (there := leave_one_out.better_moment()) is not None:
            return there
        if leave_one_out.in_parts is not None and leave_one_out.in_parts.effect.free != cause.free:
            tried, net_evidence = self._exchange(fit, leave_one_out, leave_one_out.in_parts, _Settings.better_moment)
            if net_evidence > _Settings.better_moment:
                return tried
        independence = self._independent_share(fit, cause)
        threshold = WorthSettings.named_nats + self.multiplicity_penalty(leave_one_out.hypothesis, leave_one_out.others)
        lost = leave_one_out.is_worth_less_than(
            threshold if independence == 1.0 else _full_evidence(threshold, leave_one_out.hypothesis.dof, independence)
        )
        lost = lost or not cause.is_valid
        if lost or (
            remembers(cause)
            and self.evidence_from_blocks(leave_one_out.without, leave_one_out.hypothesis) < WorthSettings.named_nats
        ):
            self._tell(f"dropped {describe(cause)}")
            return leave_one_out.without
        for candidate in leave_one_out.candidates:
            if candidate.gain < _Settings.comes_near * leave_one_out.hypothesis.gain:
                continue
            if has_simpler_name(candidate.effect, self._hypotheses, fit.simulation):
                continue
            simpler = complexity(candidate.effect) < complexity(cause)
            tried, net_evidence = self._exchange(
                fit, leave_one_out, candidate, -_Settings.equal if simpler else _Settings.equal
            )
            better = net_evidence > _Settings.equal or (abs(net_evidence) < _Settings.equal and simpler)
            if better and tried.causes[-1].is_valid:
                self._tell(f"exchanged {describe(cause)} for {describe(candidate.effect)}")
                return tried
        lead = min(
            leave_one_out.lead,
            0.5 * leave_one_out.hypothesis.gain - required_rise(threshold, leave_one_out.hypothesis.dof),
        )
        self._leads[cause.identity] = lead, fit.log_likelihood, fit.observations
        return None


def _rows_near_moment(fit: Fit, cause: Effect) -> NDArray[np.bool_]:
    """Return the rows (n,) near the moment at which a cause begins."""
    row = int(np.searchsorted(fit.observations.motion.clock, cause.values[-1]))
    return np.abs(np.arange(len(fit.weighted_residuals)) + 0.5 - row) < _Settings.near_a_moment


def _full_evidence(net_evidence: float, dof: int, independence: float) -> float:
    """Return the full worth that a cause needs if only a share of its gain counts [nats]."""
    return evidence_gain(2.0 * required_rise(net_evidence, dof) / independence, dof)


def refit_with_cause(start: Fit, sought: Effect, threshold: float, expected: float) -> Fit:
    """Refit with one more cause; guard against divergence of its period or time constant.

    Args:
        threshold, expected: required and first-order expected log-likelihood [nats].
    """
    tried = improved(start, threshold)
    if not sought.shapes or (tried.log_likelihood < threshold and tried.log_likelihood > expected - _Settings.astray):
        return tried
    cause = next(effect for effect in tried.causes if effect.identity == sought.identity)
    again = Scan(tried, [cause]).without(cause).candidate(cause)
    if again is None or np.allclose(again.effect.values, cause.values):
        return tried
    others = [effect for effect in tried.causes if effect is not cause]
    other = improved(tried.with_unfitted_causes([*others, again.effect]), tried.log_likelihood)
    return other if other.log_likelihood > tried.log_likelihood else tried


def cause_counts(causes: Sequence[Effect]) -> Named:
    """Return the identity of a set of causes without their parameters: the count of each kind at each place."""
    return frozenset(Counter(effect.key for effect in causes).items())


def contains(fit: Fit, link: Effect, zero: Effect) -> bool:
    """Return True if some numbers of a link can do the same as a joint offset, as far as the data of a fit show."""
    if not (link.kind.in_parts and zero.kind.is_zero and len(link.amounts) > len(zero.amounts)):
        return False
    if all(cause.identity != link.identity for cause in fit.causes):
        # A rotation by some degrees is not linear about its own size.
        link = link.with_values(np.zeros_like(link.values))
    columns = fit.weighted(amount_columns(fit.run, [zero, link, *fit.simulation.effects[: fit.nuisances]]))
    flat, own = columns.reshape(fit.weighted_residuals.size, -1), len(zero.amounts)
    change, others = flat[:, :own] @ zero.values[zero.amounts], flat[:, own:]
    left = change - others @ solved(others.T @ others, others.T @ change)
    return float(left @ left) < WorthSettings.same * fit.noise.sigma**2


def are_only_descriptive(causes: Sequence[Effect]) -> bool:
    """Return True if causes only describe the error: too many of them begin at a moment."""
    return sum(cause.kind.begins for cause in causes) > _Settings.max_moments


def complexity(effect: Effect) -> int:
    """Return a complexity score; of equally probable causes the one with the lowest is named."""
    return len(effect.amounts) + len(effect.shapes) + (_Settings.of_a_link if effect.kind.in_parts else 0)


def describe(effect: Effect) -> str:
    """Return an effect and its place in a few words."""
    place = "" if effect.where is None else f" at {effect.where}"
    return f"{effect.name}{place}{'' if effect.source is None else f' from {effect.source}'}"
