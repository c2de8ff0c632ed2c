"""Which causes: added one by one, taken away again when a better one makes them redundant, exchanged for rivals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from scipy import stats

from bodyschema.effects import Effect, Identity

from .fit import Fit, improved
from .held_out import Blocks, block_p_value
from .scan import Candidate, Scan
from .scatter import instruments, remembers

# A cause has to be so much more probable than its absence [nats].
NAMED = 3.0
# Candidates within this share of the best gain are refitted in full, so many at most.
_NEAR, _MOST = 0.4, 6
# ... and within this share their gain is worth knowing beyond first order.
_WORTH_IN_FULL = 0.2
_MOST_CAUSES = 20
# After so many causes more it is asked whether these are enough.
_ASKED_EACH = 3
# So many sets of causes are looked at, and none twice.
_MOST_SETS = 80
Key = tuple[str, str | None, str | None]
Named = frozenset[tuple[Key, int]]
# Of what begins at a moment, and of ripples, which differ in their periods, there are so many at one place at most.
_MOST_MOMENTS, _MOST_RIPPLES = 2, 4
# What a number costs at least [nats].
_CHEAPEST, _ROUNDS = 1.5, 30
# What explains a smaller share of what a cause explains is no rival of it; within so much two are as probable [nats].
_COMES_NEAR, _EQUAL = 0.8, 0.3
# A moment or a period that seems to explain so much more than that of the fit is tried in its place.
_ELSEWHERE = 1.0
# A period that explains less than it did by this has gone astray [nats].
_ASTRAY = 5.0
# An exchange that loses no more than this may be worth it with one cause more [nats].
_WITH_ONE_MORE = 100.0
# Fewer blocks of time than this cannot say how improbable a chance is; what is worth more is beyond doubt [nats].
_FEW_BLOCKS, _BEYOND_DOUBT = 20, 30.0
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


def rise_for(worth: float, dof: int) -> float:
    """By how much the log-likelihood has to rise for `dof` more numbers to be worth so much by `nats` [nats]."""
    if dof < 0:
        return -rise_for(-worth, -dof)
    rise = worth + _CHEAPEST * dof
    for _ in range(_ROUNDS if dof else 0):
        rise = worth + dof * max(0.5 + 0.5 * float(np.log(max(2.0 * rise, 1e-300) / dof)), _CHEAPEST)
    return rise


class Beside:
    """A fit without one of its causes, and what would take its place.

    Attributes:
        itself: the cause as it would explain most there.
        gain: what it explains as it is, to first order: twice the rise of the log-likelihood.
        candidates: those of the hypotheses that no cause is, the most probable first.
    """

    def __init__(
        self, fit: Fit, cause: Effect, itself: Candidate | None, gain: float, candidates: list[Candidate]
    ) -> None:
        self._fit = fit
        self._others = [effect for effect in fit.causes if effect is not cause]
        self._tried: dict[Identity, Fit] = {}
        self.itself = itself or Candidate(cause, 0.0, 1)
        self.gain, self.candidates = gain, candidates

    @cached_property
    def without(self) -> Fit:
        """The fit without the cause."""
        return improved(self._fit.starting(self._others))

    def is_lost_for(self, worth: float) -> bool:
        """Whether the cause is worth less than that [nats]."""
        least = self._fit.log_likelihood - rise_for(worth, self.itself.dof)
        return improved(self._fit.starting(self._others), least).log_likelihood > least

    def with_instead(self, *effects: Effect, least: float = -np.inf) -> Fit:
        """With others in the place of the cause, given up where they cannot become so probable [nats]."""
        return improved(self._fit.starting([*self._others, *effects]), least)

    def exchanged(self, candidate: Candidate, least: float) -> Fit:
        """With a candidate in the place of the cause, as it is known best."""
        effect = candidate.effect
        known = self._tried.get(effect.identity)
        if known is None or known.log_likelihood < least:
            expected = self._fit.log_likelihood + 0.5 * (candidate.gain - self.itself.gain)
            start = known or self._fit.starting([*self._others, effect])
            known = self._tried[effect.identity] = joined(start, effect, least, expected)
        return known


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
        self._known: tuple[Fit | None, Scan | None, dict[Identity, Beside]] = (None, None, {})
        self.path: list[Fit] = []
        self.ended_early = False

    def run(self, start: Fit, enough: Callable[[Sequence[Fit], float], bool] = lambda *_: False) -> Fit:
        """The causes on top of what `start` has fitted.

        `ended_early` says afterwards whether the number of steps ended the search, and not that nothing was better.

        Args:
            enough: is asked now and then, where one more cause would be worth something [nats], whether the fits on the
                way show that no further cause is called for.
        """
        fit, self.ended_early, asked = start, False, 0
        self._seen: set[Named] = set()
        self.path = [start]
        if start.causes:
            fit = self._reviewed(start)
            self.path.append(fit)
        while len(self.path) <= _MOST_CAUSES:
            added, worth = self._added(fit)
            if added is not None and len(fit.causes) >= asked + _ASKED_EACH:
                asked = len(fit.causes)
                if enough(self.path, worth):
                    break
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
        known = self._known[1] if self._known[0] is fit else None
        for candidate in self.shortlist(known or Scan(fit), self._open(fit)):
            if self.agreed(fit, candidate) < NAMED:
                continue
            doubt = self.doubt(candidate)
            least = fit.log_likelihood + rise_for(most + doubt, candidate.dof)
            start = fit.starting([*fit.causes, candidate.effect])
            tried = joined(start, candidate.effect, least, fit.log_likelihood + 0.5 * candidate.gain)
            gain = 2.0 * (tried.log_likelihood - fit.log_likelihood) * self._counted(tried, candidate.effect)
            worth = nats(gain, candidate.dof) - doubt
            if worth > most and tried.causes[-1].is_possible:
                best, most = tried, worth
        return best, most

    def is_complete(self, fit: Fit) -> bool:
        """Whether no further cause is worth naming."""
        return self._added(fit)[0] is None

    def _two_in_place_of_one(self, fit: Fit) -> Fit | None:
        """With two causes of one number each in the place of one of many; None where none is worth it."""
        for cause in fit.causes:
            beside = self.beside(fit, cause)
            if beside.itself.dof <= 2:
                continue
            open_ones = [effect for effect in self._open(fit) if effect.key != cause.key]
            pair = self._scan(fit).without(cause).best_pair(open_ones)
            if pair is None or pair[0].gain < _COMES_NEAR * beside.itself.gain:
                continue
            pair = self._with_moments(beside.without, pair)
            doubts = self.doubt(beside.itself) - sum(self.doubt(one) for one in pair)
            dof = len(pair) - beside.itself.dof
            least = fit.log_likelihood + rise_for(-doubts, dof)
            tried = beside.with_instead(*(one.effect for one in pair), least=least)
            worth = nats(2.0 * (tried.log_likelihood - fit.log_likelihood), dof) + doubts
            if worth > 0.0 and named(tried.causes) not in self._seen and all(c.is_possible for c in tried.causes):
                self._tell(f"exchanged {describe(cause)} for {' and '.join(describe(one.effect) for one in pair)}")
                return tried
        return None

    def _with_moments(self, fit: Fit, pair: tuple[Candidate, Candidate]) -> tuple[Candidate, Candidate]:
        """Two candidates, each that begins at a moment as it would explain most beside the other."""
        one, other = pair
        if one.effect.kind.begins:
            one = Scan(fit.with_causes([*fit.causes, other.effect])).candidate(one.effect) or one
        if other.effect.kind.begins:
            other = Scan(fit.with_causes([*fit.causes, one.effect])).candidate(other.effect) or other
        return one, other

    def _simpler_and_one_more(self, fit: Fit) -> Fit | None:
        """With a simpler rival in the place of a cause and another cause beside it; None where none is worth it.

        A cause of many numbers may stand for a simpler one and a small one together.
        """
        for cause in fit.causes:
            beside = self.beside(fit, cause)
            for candidate in beside.candidates:
                if candidate.dof >= beside.itself.dof or candidate.gain < _COMES_NEAR * beside.itself.gain:
                    continue
                tried, worth = self._exchanged(fit, beside, candidate, -_WITH_ONE_MORE)
                if worth < -_WITH_ONE_MORE or named(tried.causes) in self._seen or not tried.causes[-1].is_possible:
                    continue
                better, more = self._added(tried)
                if better is not None and worth + more > 1.0:
                    found = f"{describe(candidate.effect)} and {describe(better.causes[-1])}"
                    self._tell(f"exchanged {describe(cause)} for {found}")
                    return better
        return None

    def _exchanged(self, fit: Fit, beside: Beside, candidate: Candidate, least: float) -> tuple[Fit, float]:
        """With a candidate in the place of a cause, and what that is worth [nats]; roughly where below `least`."""
        doubts, dof = self.doubt(beside.itself) - self.doubt(candidate), candidate.dof - beside.itself.dof
        tried = beside.exchanged(candidate, fit.log_likelihood + rise_for(least - doubts, dof))
        return tried, nats(2.0 * (tried.log_likelihood - fit.log_likelihood), dof) + doubts

    def _open(self, fit: Fit) -> list[Effect]:
        """The hypotheses that no cause of a fit is, and one more of those that begin at a moment."""
        present = Counter(effect.key for effect in fit.causes)
        taken = {effect.identity for effect in fit.causes}
        others = []
        for effect in self._hypotheses:
            count = present[effect.key]
            if count == 0:
                others.append(effect)
            elif count < most_of_a_kind(effect):
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

    def agreed(self, fit: Fit, candidate: Candidate) -> float:
        """What a candidate is worth by the agreement of blocks of time, which need not be white inside [nats]."""
        effect, blocks = candidate.effect, Blocks.cut(len(fit.observations))
        columns = instruments(fit, effect)
        chance = block_p_value(fit, columns, blocks)
        gain = float(stats.chi2.isf(max(chance, 1e-290), candidate.dof))
        worth = nats(gain, candidate.dof) - self.doubt(candidate)
        if blocks.count < _FEW_BLOCKS and worth < NAMED:
            # Of so few blocks none is improbable enough; what explains so much needs no such witness.
            plain = nats(fit.independence * candidate.gain, candidate.dof) - self.doubt(candidate)
            worth = max(worth, plain) if plain > _BEYOND_DOUBT else worth
        return worth

    def _counted(self, fit: Fit, effect: Effect) -> float:
        """Which share of a gain counts: noise that wanders looks like what changes with time."""
        return fit.independence if effect.kind.begins or effect.name == "thermal_drift" else 1.0

    def shortlist(self, scan: Scan, hypotheses: Sequence[Effect]) -> list[Candidate]:
        """The candidates that may be the best when all is refitted, the most probable first."""
        scanned = [one for one in scan.candidates(hypotheses, _NEAR) if not scan.tolerates(one.effect)]
        most = max((one.gain for one in scanned), default=0.0)
        scanned = [scan.in_full(one) if one.gain >= _WORTH_IN_FULL * most else one for one in scanned]
        ranked = sorted(scanned, key=lambda c: nats(c.gain, c.dof) - self.doubt(c), reverse=True)
        if not ranked:
            return []
        floor = _NEAR * ranked[0].gain
        return [c for c in ranked[: 3 * _MOST] if c.gain >= floor][:_MOST]

    def _reviewed(self, fit: Fit) -> Fit:
        """Without what has become redundant, and with better ones in the place of others."""
        changed = len(fit.causes) > 0
        while changed and len(self._seen) < _MOST_SETS:
            fit, changed = self._second_thoughts(fit)
            causes = named(fit.causes)
            changed = changed and causes not in self._seen
            self._seen.add(causes)
        return fit

    def _scan(self, fit: Fit) -> Scan:
        """Of a fit and what it is without each of its causes. That of the fit last asked about is kept."""
        known, scan, _ = self._known
        if known is not fit or scan is None:
            scan = Scan(fit, fit.causes)
            self._known = (fit, scan, {})
        return scan

    def beside(self, fit: Fit, cause: Effect) -> Beside:
        """What there is in the place of a cause."""
        scan, known = self._scan(fit).without(cause), self._known[2]
        if cause.identity not in known:
            rivals = [effect for effect in self._open(fit) if effect.key != cause.key]
            itself, candidates = scan.candidate(cause), self.shortlist(scan, rivals)
            known[cause.identity] = Beside(fit, cause, itself, scan.as_it_is(cause), candidates)
        return known[cause.identity]

    def _second_thoughts(self, fit: Fit) -> tuple[Fit, bool]:
        for cause in fit.causes:
            beside = self.beside(fit, cause)
            if beside.itself.gain > beside.gain + _ELSEWHERE:
                tried = beside.with_instead(beside.itself.effect, least=fit.log_likelihood + _ELSEWHERE)
                if tried.log_likelihood > fit.log_likelihood + _ELSEWHERE:
                    return self._second_thoughts(tried)
            counted = self._counted(fit, cause)
            least = NAMED + self.doubt(beside.itself)
            lost = beside.is_lost_for(least if counted == 1.0 else _rise(least, beside.itself.dof, counted))
            if lost or (remembers(cause) and self.agreed(beside.without, beside.itself) < NAMED):
                self._tell(f"dropped {describe(cause)}")
                return beside.without, True
            for candidate in beside.candidates:
                if candidate.gain < _COMES_NEAR * beside.itself.gain:
                    continue
                simpler = simplicity(candidate.effect) < simplicity(cause)
                tried, worth = self._exchanged(fit, beside, candidate, -_EQUAL if simpler else 1.0)
                better = worth > 1.0 or (abs(worth) < _EQUAL and simpler)
                if better and tried.causes[-1].is_possible:
                    self._tell(f"exchanged {describe(cause)} for {describe(candidate.effect)}")
                    return tried, True
        return fit, False


def _rise(worth: float, dof: int, counted: float) -> float:
    """What a cause has to be worth in full where only a share of its gain counts [nats]."""
    return nats(2.0 * rise_for(worth, dof) / counted, dof)


def joined(start: Fit, sought: Effect, least: float, expected: float) -> Fit:
    """A fit with one more cause refitted, whose period or time constant may have gone astray as it moved along.

    Args:
        least, expected: what makes it worth while, and how probable it would be to first order [nats].
    """
    tried = improved(start, least)
    if not sought.shapes or (tried.log_likelihood < least and tried.log_likelihood > expected - _ASTRAY):
        return tried
    cause = next(effect for effect in tried.causes if effect.identity == sought.identity)
    again = Scan(tried, [cause]).without(cause).candidate(cause)
    if again is None or np.allclose(again.effect.values, cause.values):
        return tried
    others = [effect for effect in tried.causes if effect is not cause]
    other = improved(tried.starting([*others, again.effect]), tried.log_likelihood)
    return other if other.log_likelihood > tried.log_likelihood else tried


def named(causes: Sequence[Effect]) -> Named:
    """Which causes these are, whatever their numbers: how many of each kind at each place."""
    return frozenset(Counter(effect.key for effect in causes).items())


def most_of_a_kind(effect: Effect) -> int:
    """How many effects of a kind there may be at one place."""
    if effect.kind.begins:
        return _MOST_MOMENTS
    return _MOST_RIPPLES if effect.name == "joint_ripple" else 1


def simplicity(effect: Effect) -> int:
    """The smaller, the simpler: of causes that are as probable the simplest is named."""
    return len(effect.amounts) + (_OF_A_LINK if effect.name == "link_geometry" else 0)


def describe(effect: Effect) -> str:
    """An effect and its place in a few words."""
    place = "" if effect.where is None else f" at {effect.where}"
    return f"{effect.name}{place}{'' if effect.source is None else f' from {effect.source}'}"
