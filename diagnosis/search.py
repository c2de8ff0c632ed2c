"""Which causes: added one by one, taken away again when a better one makes them redundant, exchanged for rivals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from effects import Effect, Identity

from .fit import Fit
from .held_out import Blocks, block_p_value
from .scan import Candidate, Scan

# A cause has to be so much more probable than its absence [nats].
NAMED = 3.0
# Candidates within this share of the best gain are refitted in full, so many at most.
_NEAR, _MOST = 0.4, 6
_MOST_CAUSES = 20
# So many sets of causes are looked at, and none twice.
_MOST_SETS = 80
Key = tuple[str, str | None, str | None]
Named = frozenset[tuple[Key, int]]
# Of what begins at a moment there are so many at one place at most.
_MOST_OF_A_KIND = 2
# What a number costs at least [nats].
_CHEAPEST = 1.5
# What explains a smaller share of what a cause explains is no rival of it; within so much two are as probable [nats].
_COMES_NEAR, _EQUAL = 0.8, 0.3
# A moment or a period that seems to explain so much more than that of the fit is tried in its place.
_ELSEWHERE = 1.0
# An exchange that loses no more than this may be worth it with one cause more [nats].
_WITH_ONE_MORE = 100.0
# The camera's pose and the marker's place are simpler than the link next to them.
_OF_A_LINK = 1


def nats(gain: float, dof: int) -> float:
    """How much more probable `dof` more numbers are, which raise twice the log-likelihood by `gain`, than none.

    What explains the gain best is taken as their usual size: a Gaussian prior, scaled by empirical Bayes (George and
    Foster 2000, equation 5), but never so narrow that a number costs less than `_CHEAPEST`.
    """
    if dof < 0:
        return -nats(-gain, -dof)
    if dof == 0:
        return 0.5 * gain
    return 0.5 * gain - dof * max(0.5 + 0.5 * float(np.log(max(gain, 1e-300) / dof)), _CHEAPEST)


@dataclass(frozen=True, eq=False)
class Beside:
    """A fit without one of its causes, and what would take its place.

    Attributes:
        without: the fit.
        itself: the cause as it would explain most there.
        candidates: those of the hypotheses that no cause is, the most probable first.
    """

    without: Fit
    itself: Candidate | None
    candidates: list[Candidate]


class Search:
    """Greedy, with second thoughts.

    Args:
        hypotheses: what could be the cause.
        tell: is told what happens, in a few words.
    """

    def __init__(self, hypotheses: Sequence[Effect], tell: Callable[[str], None]) -> None:
        self._hypotheses, self._tell = hypotheses, tell
        self._doubt = np.log(max(len(hypotheses), 1))
        self._trials: dict[Key, int] = {}
        self._beside: tuple[Fit | None, dict[Identity, Beside]] = (None, {})
        self.path: list[Fit] = []
        self.ended_early = False

    def run(self, start: Fit) -> Fit:
        """The causes on top of what `start` has fitted.

        `ended_early` says afterwards whether the number of steps ended the search, and not that nothing was better.
        """
        fit, self.ended_early = start, False
        self._seen: set[Named] = set()
        self.path = [start]
        if start.causes:
            fit = self._reviewed(start)
            self.path.append(fit)
        while len(self.path) <= _MOST_CAUSES:
            added = self._added(fit)[0]
            better = added or self._two_in_place_of_one(fit) or self._simpler_and_one_more(fit)
            if better is None:
                break
            causes = named(better.causes)
            if causes in self._seen:
                break
            if added is not None:
                self._tell(f"found {describe(added.causes[-1])}")
            self._seen.add(causes)
            fit = self._reviewed(better)
            self.path.append(fit)
        self.ended_early = len(self.path) > _MOST_CAUSES or len(self._seen) >= _MOST_SETS
        return fit

    def _added(self, fit: Fit) -> tuple[Fit | None, float]:
        """With one more cause, and what that is worth [nats]; None where nothing is probable enough."""
        best, most = None, NAMED
        for candidate in self.shortlist(fit, self._open(fit)):
            if self._agreed(fit, candidate) < NAMED:
                continue
            tried = self.refined(fit.with_causes([*fit.causes, candidate.effect]), candidate.effect)
            worth = nats(2.0 * (tried.log_likelihood - fit.log_likelihood), candidate.dof) - self.doubt(candidate)
            if worth > most and tried.causes[-1].is_possible:
                best, most = tried, worth
        return best, most

    def _two_in_place_of_one(self, fit: Fit) -> Fit | None:
        """With two causes of one number each in the place of one of many; None where none is worth it."""
        for cause in fit.causes:
            beside = self.beside(fit, cause)
            itself = beside.itself or Candidate(cause, 0.0, 1)
            if itself.dof <= 2:
                continue
            pair = Scan(beside.without).best_pair(effect for effect in self._open(fit) if effect.key != cause.key)
            if pair is None or pair[0].gain < _COMES_NEAR * itself.gain:
                continue
            tried = beside.without.with_causes([*beside.without.causes, *(one.effect for one in pair)])
            worth = nats(2.0 * (tried.log_likelihood - fit.log_likelihood), len(pair) - itself.dof)
            worth += self.doubt(itself) - sum(self.doubt(one) for one in pair)
            if worth > 0.0 and named(tried.causes) not in self._seen and all(c.is_possible for c in tried.causes):
                self._tell(f"exchanged {describe(cause)} for {' and '.join(describe(one.effect) for one in pair)}")
                return tried
        return None

    def _simpler_and_one_more(self, fit: Fit) -> Fit | None:
        """With a simpler rival in the place of a cause and another cause beside it; None where none is worth it.

        A cause of many numbers may stand for a simpler one and a small one together.
        """
        for cause in fit.causes:
            beside = self.beside(fit, cause)
            itself = beside.itself or Candidate(cause, 0.0, 1)
            for candidate in beside.candidates:
                if candidate.dof >= itself.dof or candidate.gain < _COMES_NEAR * itself.gain:
                    continue
                tried, worth = self._exchanged(fit, beside, itself, candidate)
                if worth < -_WITH_ONE_MORE or named(tried.causes) in self._seen or not tried.causes[-1].is_possible:
                    continue
                better, more = self._added(tried)
                if better is not None and worth + more > 1.0:
                    found = f"{describe(candidate.effect)} and {describe(better.causes[-1])}"
                    self._tell(f"exchanged {describe(cause)} for {found}")
                    return better
        return None

    def _exchanged(self, fit: Fit, beside: Beside, itself: Candidate, candidate: Candidate) -> tuple[Fit, float]:
        """With a candidate in the place of a cause, refitted, and what that is worth [nats]."""
        without = beside.without
        tried = self.refined(without.with_causes([*without.causes, candidate.effect]), candidate.effect)
        worth = nats(2.0 * (tried.log_likelihood - fit.log_likelihood), candidate.dof - itself.dof)
        return tried, worth + self.doubt(itself) - self.doubt(candidate)

    def _open(self, fit: Fit) -> list[Effect]:
        """The hypotheses that no cause of a fit is, and one more of those that begin at a moment."""
        present = Counter(effect.key for effect in fit.causes)
        taken = {effect.identity for effect in fit.causes}
        others = []
        for effect in self._hypotheses:
            count = present[effect.key]
            if count == 0:
                others.append(effect)
            elif effect.kind.begins and count < _MOST_OF_A_KIND:
                more = (effect.one_more(ordinal) for ordinal in range(count + 1))
                others.append(next(one for one in more if one.identity not in taken))
        return others

    def doubt(self, candidate: Candidate) -> float:
        """What having looked for it in so many places costs [nats]."""
        self._trials[candidate.effect.key] = candidate.trials
        return float(self._doubt + np.log(candidate.trials))

    def doubt_of(self, effect: Effect) -> float:
        """The same of an effect that was a candidate."""
        return float(self._doubt + np.log(self._trials.get(effect.key, 1)))

    def _agreed(self, fit: Fit, candidate: Candidate) -> float:
        """What a candidate is worth by the agreement of blocks of time, which need not be white inside [nats]."""
        effect = candidate.effect
        columns = fit.weighted(fit.run.columns(effect)[:, :, effect.amounts])
        chance = block_p_value(fit, columns, Blocks.cut(len(fit.observations)))
        gain = float(stats.chi2.isf(max(chance, 1e-290), candidate.dof))
        return nats(gain, candidate.dof) - self.doubt(candidate)

    def shortlist(self, fit: Fit, hypotheses: Sequence[Effect]) -> list[Candidate]:
        """The candidates that may be the best when all is refitted, the most probable first."""
        scanned = Scan(fit).candidates(hypotheses)
        ranked = sorted(scanned, key=lambda c: nats(c.gain, c.dof) - self.doubt(c), reverse=True)
        if not ranked:
            return []
        floor = _NEAR * ranked[0].gain
        return [c for c in ranked[: 3 * _MOST] if c.gain >= floor][:_MOST]

    def refined(self, fit: Fit, sought: Effect) -> Fit:
        """With the period or time constant of one cause sought again: as it moved along it may have gone astray."""
        cause = next(effect for effect in fit.causes if effect.identity == sought.identity)
        if not cause.shapes:
            return fit
        others = [effect for effect in fit.causes if effect is not cause]
        again = Scan(fit.with_causes(others)).candidate(cause)
        if again is None or np.allclose(again.effect.values, cause.values):
            return fit
        tried = fit.with_causes([*others, again.effect])
        return tried if tried.log_likelihood > fit.log_likelihood else fit

    def _reviewed(self, fit: Fit) -> Fit:
        """Without what has become redundant, and with better ones in the place of others."""
        changed = len(fit.causes) > 0
        while changed and len(self._seen) < _MOST_SETS:
            fit, changed = self._second_thoughts(fit)
            causes = named(fit.causes)
            changed = changed and causes not in self._seen
            self._seen.add(causes)
        return fit

    def beside(self, fit: Fit, cause: Effect) -> Beside:
        """What there is in the place of a cause. That of the fit last asked about is kept."""
        if self._beside[0] is not fit:
            self._beside = (fit, {})
        known = self._beside[1]
        if cause.identity not in known:
            without = fit.without(cause)
            rivals = [effect for effect in self._open(fit) if effect.key != cause.key]
            known[cause.identity] = Beside(without, Scan(without).candidate(cause), self.shortlist(without, rivals))
        return known[cause.identity]

    def _second_thoughts(self, fit: Fit) -> tuple[Fit, bool]:
        for cause in fit.causes:
            beside = self.beside(fit, cause)
            without, others = beside.without, beside.without.causes
            itself = beside.itself or Candidate(cause, 0.0, 1)
            gain = 2.0 * (fit.log_likelihood - without.log_likelihood)
            if itself.gain > gain + _ELSEWHERE:
                tried = fit.with_causes([*others, itself.effect])
                if tried.log_likelihood > fit.log_likelihood + _ELSEWHERE:
                    return self._second_thoughts(tried)
            lost = nats(gain, itself.dof)
            if lost < NAMED + self.doubt(itself):
                self._tell(f"dropped {describe(cause)}")
                return without, True
            for candidate in beside.candidates:
                if candidate.gain < _COMES_NEAR * itself.gain:
                    continue
                tried, worth = self._exchanged(fit, beside, itself, candidate)
                better = worth > 1.0 or (abs(worth) < _EQUAL and simplicity(candidate.effect) < simplicity(cause))
                if better and tried.causes[-1].is_possible:
                    self._tell(f"exchanged {describe(cause)} for {describe(candidate.effect)}")
                    return tried, True
        return fit, False


def named(causes: Sequence[Effect]) -> Named:
    """Which causes these are, whatever their numbers: how many of each kind at each place."""
    return frozenset(Counter(effect.key for effect in causes).items())


def simplicity(effect: Effect) -> int:
    """The smaller, the simpler: of causes that are as probable the simplest is named."""
    return len(effect.amounts) + (_OF_A_LINK if effect.name == "link_geometry" else 0)


def describe(effect: Effect) -> str:
    """An effect and its place in a few words."""
    place = "" if effect.where is None else f" at {effect.where}"
    return f"{effect.name}{place}{'' if effect.source is None else f' from {effect.source}'}"
