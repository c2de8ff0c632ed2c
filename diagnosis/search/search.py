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
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.fit.scatter import beyond_single_rows, instruments, remembers
from bodyschema.diagnosis.fit.worth import WorthSettings, choices, cost, nats, rise_for
from bodyschema.effects import Effect, Identity

from .held_out import Blocks, block_p_value
from .hypotheses import has_simpler_name
from .scan import Candidate, Scan, moment_again


class _Settings:
    """Settings of the search.

    Sensitivity, each at 0.3 and 3 times over seven recordings with hidden errors: with `near` or `comes_near` above 1,
    and with fewer candidates (`most`), other rivals are tried, and five, four and three reports differ. The others
    change nothing there: no search is long, and no cause begins at more than three moments.
    """

    near, most = 0.4, 6  # candidates within this share of the best gain are refitted, up to this number
    worth_in_full = 0.2  # candidates within this share of the best gain are evaluated beyond first order
    # With more causes than this, the error has been described and not explained; maximum of steps of the search.
    most_causes, most_steps = 12, 20
    most_moments = 3  # more jumps, slips and bumps than this in one recording describe something that comes and goes
    most_sets = 60  # maximum of sets of causes to examine; none is examined twice
    # Multiple of a limit, and the margin to it [nats], beyond which the first order decides.
    # With 0.3 to 3 times these, three recordings had the same causes, probabilities to 0.001 and RMS to 0.01 %.
    clearly, at_least = 2.0, 10.0
    # A rival must explain this share of a cause's gain; differences within this count as equal [nats].
    comes_near, equal = 0.8, 0.3
    # Largest part of the evidence between two memory effects of a joint that may lie in a few rows [nats].
    of_single_rows = 10.0
    elsewhere = 1.0  # a moment or a period that promises this much more than the fitted one is tried
    # As many rows beside a moment may be on its wrong side and seem to be outliers (more are a change, as the noise has
    # it), where the weight of some is smaller than this.
    near_a_moment, off = 27, 0.5
    astray = 5.0  # a period that explains less than before by this has diverged [nats]
    # With fewer blocks of time, p-values are too coarse; a gain above this needs no p-value [nats].
    few_blocks, beyond_doubt = 20, 30.0
    of_a_link = 1  # the camera's pose and the marker's position are simpler than the adjacent link


Key = tuple[str, str | None, str | None]
Named = frozenset[tuple[Key, int]]


class Beside:
    """A fit without one of its causes, with the candidates to replace it.

    Attributes:
        others: the other causes.
        itself: the cause with its best first-order fit.
        gain: its present first-order gain, Δχ².
        in_parts: the cause with the best choice of its amounts; None if there is no choice.
        candidates: hypotheses that are not yet causes, the most probable first.
    """

    def __init__(
        self,
        fit: Fit,
        cause: Effect,
        itself: Candidate | None,
        gain: float,
        in_parts: Candidate | None,
        candidates: list[Candidate],
    ) -> None:
        self._fit, self._cause = fit, cause
        self.others = [effect for effect in fit.causes if effect is not cause]
        self._tried: dict[Identity, Fit] = {}
        self.itself = itself or Candidate(cause, 0.0, 1)
        self.gain, self.in_parts, self.candidates = gain, in_parts, candidates

    @cached_property
    def without(self) -> Fit:
        """Return the fit without the cause.

        Another cause that begins nearby may have left rows to this one, and gets another moment without it.
        """
        fit = improved(self._fit.starting(self.others))
        if not self._cause.kind.begins:
            return fit
        for k in range(len(fit.causes)):
            other = fit.causes[k]
            again = moment_again(fit, other, _near_moment(fit, other)) if other.kind.begins else None
            if again is not None:
                moved = fit.starting([*fit.causes[:k], again.effect, *fit.causes[k + 1 :]])
                fit = max(fit, improved(moved), key=lambda one: one.log_likelihood)
        return fit

    @property
    def lead(self) -> float:
        """First-order lead of the cause over the best candidate to replace it [nats]."""
        return 0.5 * (self.itself.gain - max((one.gain for one in self.candidates), default=0.0))

    def cost_of(self, candidate: Candidate) -> float:
        """Return the cost of a candidate's numbers beyond those of the cause [nats].

        Each number of an effect is known to a small fraction of the effect's size, so that the simpler effect is
        favoured by more than the number of its parameters.
        """
        return cost(candidate.gain, candidate.dof) - cost(self.itself.gain, self.itself.dof)

    def is_lost_for(self, worth: float) -> bool:
        """Return True if the cause is worth less than `worth` [nats]."""
        rise = rise_for(worth, self.itself.dof)
        least = self._fit.log_likelihood - rise
        if self._cause.kind.begins and any(one.kind.begins for one in self.others):
            return self.without.log_likelihood > least
        if self._fit.loss(self._cause) > _Settings.clearly * rise + _Settings.at_least:
            return False
        return improved(self._fit.starting(self.others), least).log_likelihood > least

    def elsewhere(self) -> Fit | None:
        """Refit with a better moment or period of the cause; None if there is none."""
        fit, cause = self._fit, self._cause
        least = fit.log_likelihood + _Settings.elsewhere
        tried = [self.itself] if self.itself.gain > self.gain + _Settings.elsewhere else []
        if cause.kind.begins:
            near = _near_moment(fit, cause)
            if (fit.noise.weights[near & fit.observations.trusted] < _Settings.off).any():
                tried += [again for again in [moment_again(fit, cause, near)] if again is not None]
        for candidate in tried:
            there = improved(fit.starting([*self.others, candidate.effect]), least)
            if there.log_likelihood > least:
                return there
        return None

    def exchanged(self, candidate: Candidate, least: float) -> Fit:
        """Refit with a candidate instead of the cause; the best such fit is kept."""
        effect = candidate.effect
        known = self._tried.get(effect.identity)
        if known is None or known.log_likelihood < least:
            expected = self._fit.log_likelihood + 0.5 * (candidate.gain - self.itself.gain)
            start = known or self._fit.starting([*self.others, effect])
            known = self._tried[effect.identity] = joined(start, effect, least, expected)
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
        self._known: tuple[Fit | None, Scan | None, dict[Identity, Beside]] = (None, None, {})
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
            fit = self._reviewed(start)
            self._went_to(fit)
        while (
            len(self.path) <= _Settings.most_steps
            and len(fit.causes) <= _Settings.most_causes
            and len(self._seen) < _Settings.most_sets
        ):
            added = self._added(fit)
            if added is None or (causes := named(added.causes)) in self._seen:
                break
            self._tell(f"found {describe(added.causes[-1])}")
            self._seen.add(causes)
            fit = self._reviewed(added)
            self._went_to(fit)
        is_long = len(self.path) > _Settings.most_steps or len(self._seen) >= _Settings.most_sets
        self.ended_early = is_long or len(fit.causes) > _Settings.most_causes
        return fit

    def _went_to(self, fit: Fit) -> None:
        """Append a fit to the path; the one before drops its cached results, which are large for many rows."""
        self.path[-1] = replace(self.path[-1])
        self.path.append(fit)

    def _added(self, fit: Fit) -> Fit | None:
        """Add one more cause; None if no candidate is probable enough."""
        best, most = None, WorthSettings.named_nats
        known = self._known[1] if self._known[0] is fit else None
        named_so = [one for one in self._open(fit) if not has_simpler_name(one, self._hypotheses, fit.simulation)]
        for candidate in self.shortlist(known or Scan(fit), named_so):
            if self.agreed(fit, candidate) < WorthSettings.named_nats:
                continue
            doubt = self.doubt(candidate, fit.causes)
            least = fit.log_likelihood + rise_for(most + doubt, candidate.dof)
            start = fit.starting([*fit.causes, candidate.effect])
            tried = joined(start, candidate.effect, least, fit.log_likelihood + 0.5 * candidate.gain)
            gain = 2.0 * (tried.log_likelihood - fit.log_likelihood) * self._share_that_counts(tried, candidate.effect)
            worth = nats(gain, candidate.dof) - doubt
            if worth > most and tried.causes[-1].is_possible:
                best, most = tried, worth
        return best

    def _exchanged(self, fit: Fit, beside: Beside, candidate: Candidate, least: float) -> tuple[Fit, float]:
        """Exchange a cause for a candidate, and return the evidence gain [nats]; approximate if below `least`."""
        costs = beside.cost_of(candidate)
        doubts = self.doubt(beside.itself, beside.others) - self.doubt(candidate, beside.others)
        doubts += self.for_zero(fit, beside.itself, candidate)
        alike = remembers(beside.itself.effect) and remembers(candidate.effect)
        least -= _Settings.of_single_rows if alike else 0.0
        tried = beside.exchanged(candidate, fit.log_likelihood + least - doubts + costs)
        worth = tried.log_likelihood - fit.log_likelihood - costs + doubts
        return tried, worth + (beyond_single_rows(fit, tried) if alike else 0.0)

    def for_zero(self, fit: Fit, cause: Candidate, other: Candidate) -> float:
        """Return the bonus for `other` instead of a cause if one is a joint offset that the other contains [nats].

        A link rotated about its joint's axis, or about the previous one, is that joint's offset. Its further numbers
        must be worth a name in addition to the offset.
        """
        if contains(fit, cause.effect, other.effect):
            return WorthSettings.named_nats + self.doubt(other)
        return -WorthSettings.named_nats - self.doubt(cause) if contains(fit, other.effect, cause.effect) else 0.0

    def _open(self, fit: Fit) -> list[Effect]:
        """Return the hypotheses that are not causes of a fit, with one more of each that begins at a moment."""
        present = Counter(effect.key for effect in fit.causes)
        taken = {effect.identity for effect in fit.causes}
        others = []
        for effect in self._hypotheses:
            count = present[effect.key]
            if count == 0:
                others.append(effect)
            elif count < effect.kind.most_at_one_place:
                more = (effect.one_more(ordinal) for ordinal in range(count + 1))
                others.append(next(one for one in more if one.identity not in taken))
        return others

    def doubt(self, candidate: Candidate, beside: Iterable[Effect] = ()) -> float:
        """Return the multiplicity penalty for the number of places searched, beside other causes [nats]."""
        self._trials[candidate.effect.key] = candidate.trials
        others = list(beside)
        zeros = [cause for cause in others if cause.kind.is_zero]
        # All joint offsets together count as one name.
        first = self.multiplicity - float(np.log(1 + len(others) - max(len(zeros) - 1, 0)))
        is_another = candidate.effect.kind.is_zero and any(one.kind.is_zero for one in others)
        return (min(first, WorthSettings.another_nats) if is_another else first) + float(np.log(candidate.trials))

    def doubt_of(self, effect: Effect) -> float:
        """Return the multiplicity penalty of an effect that was a candidate [nats]."""
        trials = choices(effect) if effect.kind.in_parts else self._trials.get(effect.key, 1)
        return float(self.multiplicity + np.log(trials))

    def worth(self, fit: Fit, cause: Effect) -> float:
        """Return the evidence gain of a cause of a fit over leaving it out [nats]."""
        beside = self.beside(fit, cause)
        gain = 2.0 * (fit.log_likelihood - beside.without.log_likelihood)
        worth = nats(gain, beside.itself.dof) - self.doubt(beside.itself, beside.others)
        return min(worth, self.agreed(beside.without, beside.itself)) if remembers(cause) else worth

    def agreed(self, fit: Fit, candidate: Candidate) -> float:
        """Return a candidate's worth by the agreement of blocks of time, which may be correlated inside [nats]."""
        effect, blocks = candidate.effect, Blocks.cut(len(fit.observations))
        columns = instruments(fit, effect)
        chance = block_p_value(fit, columns, blocks)
        gain = float(chdtri(candidate.dof, max(chance, 1e-290)))
        doubt = self.doubt(candidate, fit.causes)
        worth = nats(gain, candidate.dof) - doubt
        if blocks.count < _Settings.few_blocks and worth < WorthSettings.named_nats:
            # Few blocks cannot give a small p-value; a large gain counts without them.
            plain = nats(fit.independence * candidate.gain, candidate.dof) - doubt
            worth = max(worth, plain) if plain > _Settings.beyond_doubt else worth
        return worth

    def _share_that_counts(self, fit: Fit, effect: Effect) -> float:
        """Return the share of a gain that counts: correlated noise looks like a change with time."""
        return fit.independence if effect.kind.changes_with_time else 1.0

    def shortlist(self, scan: Scan, hypotheses: Sequence[Effect]) -> list[Candidate]:
        """Return the candidates that may be best after a refit, the most probable first."""
        scanned = [one for one in scan.candidates(hypotheses, _Settings.near) if not scan.tolerates(one.effect)]
        most = max((one.gain for one in scanned), default=0.0)
        scanned = [scan.in_full(one) if one.gain >= _Settings.worth_in_full * most else one for one in scanned]
        ranked = sorted(scanned, key=lambda c: nats(c.gain, c.dof) - self.doubt(c), reverse=True)
        if not ranked:
            return []
        floor = _Settings.near * ranked[0].gain
        return [c for c in ranked[: 3 * _Settings.most] if c.gain >= floor][: _Settings.most]

    def _reviewed(self, fit: Fit) -> Fit:
        """Review one cause after another, until each was reviewed after the last change that may concern it."""
        waiting = [cause.identity for cause in fit.causes]
        while waiting and len(self._seen) < _Settings.most_sets:
            cause = next(effect for effect in fit.causes if effect.identity == waiting[0])
            better = None if self._leads_clearly(fit, cause) else self._second_thoughts(fit, cause)
            later = waiting[1:]
            if better is None:
                waiting = later
                continue
            causes = named(better.causes)
            is_seen = causes in self._seen and causes != named(fit.causes)
            fit = better
            if is_seen:
                break
            self._seen.add(causes)
            there = [effect.identity for effect in fit.causes]
            waiting = [one for one in later if one in there] + [one for one in there if one not in later]
        return fit

    def _leads_clearly(self, fit: Fit, cause: Effect) -> bool:
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

    def beside(self, fit: Fit, cause: Effect) -> Beside:
        """Return the fit without a cause and the candidates for its place."""
        scan, known = self._scan(fit).without(cause), self._known[2]
        if cause.identity not in known:
            rivals = [effect for effect in self._open(fit) if effect.key != cause.key]
            itself, candidates = scan.candidate(cause), self.shortlist(scan, rivals)
            in_parts = scan.candidate(cause.freeing(None)) if cause.kind.in_parts else None
            known[cause.identity] = Beside(fit, cause, itself, scan.as_it_is(cause), in_parts, candidates)
        return known[cause.identity]

    def _second_thoughts(self, fit: Fit, cause: Effect) -> Fit | None:
        """Return the fit with a cause refined, dropped or exchanged; None if it stays unchanged."""
        beside = self.beside(fit, cause)
        if (there := beside.elsewhere()) is not None:
            return there
        if beside.in_parts is not None and beside.in_parts.effect.free != cause.free:
            tried, worth = self._exchanged(fit, beside, beside.in_parts, _Settings.elsewhere)
            if worth > _Settings.elsewhere:
                return tried
        counted = self._share_that_counts(fit, cause)
        least = WorthSettings.named_nats + self.doubt(beside.itself, beside.others)
        lost = beside.is_lost_for(least if counted == 1.0 else _rise(least, beside.itself.dof, counted))
        lost = lost or not cause.is_possible
        if lost or (remembers(cause) and self.agreed(beside.without, beside.itself) < WorthSettings.named_nats):
            self._tell(f"dropped {describe(cause)}")
            return beside.without
        for candidate in beside.candidates:
            if candidate.gain < _Settings.comes_near * beside.itself.gain:
                continue
            if has_simpler_name(candidate.effect, self._hypotheses, fit.simulation):
                continue
            simpler = simplicity(candidate.effect) < simplicity(cause)
            tried, worth = self._exchanged(fit, beside, candidate, -_Settings.equal if simpler else _Settings.equal)
            better = worth > _Settings.equal or (abs(worth) < _Settings.equal and simpler)
            if better and tried.causes[-1].is_possible:
                self._tell(f"exchanged {describe(cause)} for {describe(candidate.effect)}")
                return tried
        lead = min(beside.lead, 0.5 * beside.itself.gain - rise_for(least, beside.itself.dof))
        self._leads[cause.identity] = lead, fit.log_likelihood, fit.observations
        return None


def _near_moment(fit: Fit, cause: Effect) -> NDArray[np.bool_]:
    """Return the rows (n,) near the moment at which a cause begins."""
    row = int(np.searchsorted(fit.observations.motion.clock, cause.values[-1]))
    return np.abs(np.arange(len(fit.left)) + 0.5 - row) < _Settings.near_a_moment


def _rise(worth: float, dof: int, counted: float) -> float:
    """Return the full worth that a cause needs if only a share of its gain counts [nats]."""
    return nats(2.0 * rise_for(worth, dof) / counted, dof)


def joined(start: Fit, sought: Effect, least: float, expected: float) -> Fit:
    """Refit with one more cause; guard against divergence of its period or time constant.

    Args:
        least, expected: required and first-order expected log-likelihood [nats].
    """
    tried = improved(start, least)
    if not sought.shapes or (tried.log_likelihood < least and tried.log_likelihood > expected - _Settings.astray):
        return tried
    cause = next(effect for effect in tried.causes if effect.identity == sought.identity)
    again = Scan(tried, [cause]).without(cause).candidate(cause)
    if again is None or np.allclose(again.effect.values, cause.values):
        return tried
    others = [effect for effect in tried.causes if effect is not cause]
    other = improved(tried.starting([*others, again.effect]), tried.log_likelihood)
    return other if other.log_likelihood > tried.log_likelihood else tried


def named(causes: Sequence[Effect]) -> Named:
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
    flat, own = columns.reshape(fit.left.size, -1), len(zero.amounts)
    change, others = flat[:, :own] @ zero.values[zero.amounts], flat[:, own:]
    left = change - others @ solved(others.T @ others, others.T @ change)
    return float(left @ left) < WorthSettings.same * fit.noise.sigma**2


def are_a_description(causes: Sequence[Effect]) -> bool:
    """Return True if causes only describe the error: too many of them begin at a moment."""
    return sum(cause.kind.begins for cause in causes) > _Settings.most_moments


def simplicity(effect: Effect) -> int:
    """Return a complexity score; of equally probable causes the one with the lowest is named."""
    return len(effect.amounts) + len(effect.shapes) + (_Settings.of_a_link if effect.kind.in_parts else 0)


def describe(effect: Effect) -> str:
    """Return an effect and its place in a few words."""
    place = "" if effect.where is None else f" at {effect.where}"
    return f"{effect.name}{place}{'' if effect.source is None else f' from {effect.source}'}"
