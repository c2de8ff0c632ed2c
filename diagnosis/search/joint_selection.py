"""Compare sets of causes by their evidence beside the background, since some explain the error only together.

With one of four wrong joint offsets freed, the tolerances still have to be ten times a workshop's, and this offset
seems worth nothing. With all four freed they fall, which is worth much. So the search starts from nothing, from all
offsets, and from all effects of each kind; it removes, adds and exchanges causes. The scales of the tolerances are
fitted to each set.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bodyschema.diagnosis.fit.background import BackgroundSettings, Scales
from bodyschema.diagnosis.fit.fit import Fit, solved
from bodyschema.diagnosis.fit.net_evidence import WorthSettings
from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray

from .hypotheses import has_simpler_name
from .scan import Candidate, Scan
from .search import Key
from .sets import SCALES, CauseSet, CauseSets, SetSettings


class _Settings:
    max_refitted = 8  # maximum of refitted sets
    # Tolerances may stand for a cause of which they leave less than this share of the squares; a third is left of a
    # jump.
    followed_share = 0.1


@dataclass(frozen=True, eq=False)
class ToleranceEstimate:
    """Estimated sizes of the tolerances."""

    scales: Scales  # the most probable ones
    log_sigma: FloatArray  # standard deviations of their logarithms (4,)
    is_detected: NDArray[np.bool_]  # True for scales that show in the data (4,)
    upper_limit: (
        FloatArray  # the largest ones (4,) that the data do not rule out with 95 %; of use where they do not show
    )


def together(start: Fit, hypotheses: Sequence[Effect], tell: Callable[[str], None] = lambda _: None) -> Fit:
    """Fit the set of causes with the most evidence beside tolerances everywhere.

    The best sets to first order are refitted and compared again about their own parameters, until no other is near.

    Args:
        start: a fit without a background.
        tell: called with short messages on progress.
    """
    known = [_Linearisation(start.with_tolerances(Scales()), hypotheses, ())]
    while len(known) < _Settings.max_refitted:
        visits = Counter(linearisation.name for linearisation in known)
        best = max(known, key=lambda linearisation: linearisation.current.net_evidence)
        # A set fitted far from its own parameters is fitted once more, from where it seems better than all.
        proposals = [
            (one.net_evidence, linearisation, one)
            for linearisation in known
            for one in linearisation.reached
            if not (times := visits[linearisation.name_of(one)])
            or (times == 1 and one.net_evidence > best.current.net_evidence + SetSettings.still)
        ]
        net_evidence, linearisation, one = max(
            proposals, key=lambda proposal: proposal[0], default=(-np.inf, known[0], known[0].current)
        )
        if net_evidence < best.current.net_evidence - SetSettings.comes_near_nats:
            linearisation, one = best, best.with_all_zeros
            if best.current.scales.angles <= 1.0 or linearisation.name_of(one) in visits:
                fewer = best.without_weakest()
                if fewer is None:
                    break
                known.append(_Linearisation(fewer, hypotheses, known))
                continue
        known.append(_Linearisation(linearisation.refitted(one), hypotheses, known))
        tell(f"{len(known)} fitted")
    return max(known, key=lambda linearisation: linearisation.current.net_evidence).fit


def alternatives_to_tolerances(fit: Fit, hypotheses: Sequence[Effect]) -> list[tuple[Effect, float]]:
    """Return possible causes, beside those of a fit, instead of tolerances of several times a workshop's.

    These are links, the camera's pose and scale, and the marker's position: beside one of them the tolerances may be
    smaller.

    Returns:
        Each with its probability among sets with one of these or none, without the margin for naming it.
    """
    if fit.background.scales is None or not fit.background.scales.excess_over_workshop:
        return []
    # Beside large tolerances they may not be identifiable; beside smaller ones they are.
    large = [Candidate(one, 0.0, 1) for one in _open_hypotheses(fit, hypotheses) if one.kind.is_like_tolerances]
    sets = _sets_of(fit, large, float(np.log(max(len(hypotheses), 1))))
    current = sets.of(sets.matching(fit.causes))
    named, ones = WorthSettings.named_nats, sets.with_one(current)
    found = [(effect, one.net_evidence + named * (one.scales.excess_over_workshop + 1.0)) for effect, one in ones]
    without = current.net_evidence + named * current.scales.excess_over_workshop
    odds = np.exp(np.minimum([net_evidence - without for _, net_evidence in found], 700.0))
    shares = (odds / (1.0 + odds.sum())).tolist()
    return sorted(((effect, p) for (effect, _), p in zip(found, shares, strict=True)), key=lambda one: -one[1])


def estimated_tolerances(fit: Fit) -> ToleranceEstimate:
    """Return the scales of tolerances with the most evidence beside the causes of a fit."""
    if fit.background.scales is None:
        unseen = np.zeros(SCALES, dtype=np.bool_)
        log_sigma, most = (
            np.full(SCALES, each) for each in (BackgroundSettings.spread, BackgroundSettings.largest_scale)
        )
        return ToleranceEstimate(Scales(), log_sigma, unseen, most)
    causes = [Candidate(cause, 0.0, 1) for cause in fit.causes]
    sets = CauseSets(fit, causes, 0.0)
    current = sets.of(tuple(range(len(causes))))
    log_sigma = 1.0 / np.sqrt(2.0 * current.effective_dof + 1.0 / BackgroundSettings.spread**2)
    return ToleranceEstimate(current.scales, log_sigma, sets.detected_scales(current), sets.upper_limits(current))


def is_at_limit(scales: Scales | None) -> bool:
    """Return True if tolerances of links or axes are at their upper limit."""
    limit = (1.0 - SetSettings.still) * BackgroundSettings.largest_scale
    return scales is not None and max(scales.lengths, scales.angles) > limit


def exceeds_tolerances(fit: Fit, cause: Effect, naming_cost: float) -> bool | None:
    """Return True if a cause is more probable than larger tolerances; None if tolerances cannot replace it.

    Args:
        naming_cost: minimum cost of naming it [nats].
    """
    if fit.background.scales is None or _share_beyond_tolerances(fit, cause) > _Settings.followed_share:
        return None
    everything = [Candidate(one, 0.0, 1) for one in fit.causes]
    others = [one for one in everything if one.effect is not cause]
    whole = CauseSets(fit, everything, naming_cost).of(tuple(range(len(everything))))
    # Each of two causes may seem necessary beside tolerances that only both together make small. Naming them is then a
    # single decision, although each name has been charged for it.
    fewer = CauseSets(fit, others, naming_cost).hill_climbed((tuple(range(len(others))), ()))
    return all(
        whole.net_evidence > one.net_evidence - WorthSettings.named_nats * (len(others) - len(one.chosen))
        for one in fewer
    )


def _share_beyond_tolerances(fit: Fit, cause: Effect) -> float:
    """Return the share of a cause's squared change that other effects and tolerances of any size cannot follow.

    They can follow a joint offset, which is a rotation of its link, and a wrong ratio of a joint that moves little.
    """
    places = fit.places(cause)[: len(cause.amounts)]
    flat = fit.columns.reshape(fit.weighted_residuals.size, -1)
    change = flat[:, places] @ cause.values[cause.amounts]
    others = np.delete(flat, places, axis=1)
    left = change - others @ solved(others.T @ others, others.T @ change)
    return float(left @ left) / max(float(change @ change), 1e-300)


class _Linearisation:
    """A fit with its causes, and the sets of causes reached from it."""

    def __init__(self, fit: Fit, hypotheses: Sequence[Effect], others: Sequence[_Linearisation]) -> None:
        self.fit = fit
        self._naming_cost = float(np.log(max(len(hypotheses), 1)))
        self._sets = _sets_of(
            fit,
            [_at_zero(one) for one in _candidates_with_links(fit, _open_hypotheses(fit, hypotheses))],
            self._naming_cost,
        )
        own = self._sets.matching(fit.causes)
        self.current = self._sets.of(own)
        if (
            self.current.net_evidence
            > max((linearisation.current.net_evidence for linearisation in others), default=-np.inf)
            + SetSettings.comes_near_nats
        ):
            starts = self._sets.starts(own, links=not others)
        else:
            # A fit that is not clearly better than others continues from the sets that these have reached.
            reached = (
                self._sets.matching(linearisation.numbers_of(one))
                for linearisation in others
                for one in linearisation.reached
            )
            starts = [own, *reached, *self._sets.zeros_for_links(own)]
        self.reached = self._sets.hill_climbed(dict.fromkeys(starts))
        self.name = self.name_of(self.current)
        # Drop cached results, which are large for many rows.
        self.fit = replace(fit)

    def name_of(self, one: CauseSet) -> frozenset[Key]:
        """Return the keys of the causes of a set, without their parameters."""
        return frozenset(self._sets.effects[k].key for k in one.chosen)

    @property
    def with_all_zeros(self) -> CauseSet:
        """The set with all joint offsets in addition.

        Beside tolerances that replace them they seem to be worth nothing to first order, because an offset moves the
        marker along an arc.
        """
        zeros = [k for k, effect in enumerate(self._sets.effects) if effect.kind.is_zero]
        return self._sets.without_impossible(self._sets.of(tuple(dict.fromkeys((*self.current.chosen, *zeros)))))

    def without_weakest(self) -> Fit | None:
        """Refit without the least necessary rigid cause, if that is more probable; None if all are necessary.

        Without it tolerances may grow to angles where the linearisation about this fit no longer holds. The set may
        have been fitted before, about other parameters.
        """
        fewer = []
        for cause in self.fit.causes:
            if cause.kind.rigid:
                others = self._sets.matching([other for other in self.fit.causes if other is not cause])
                fewer.append(self.refitted(self._sets.of(others, self.current)))
        best = max(fewer, key=self._worth, default=None)
        return best if best is not None and self._worth(best) > self.current.net_evidence + SetSettings.still else None

    def numbers_of(self, one: CauseSet) -> list[Effect]:
        """Return the causes, separating the numbers of those that may have a subset of them."""
        return [self._sets.effects[k] for k in one.chosen]

    def refitted(self, one: CauseSet) -> Fit:
        """Refit one of the sets about its own parameters.

        Tolerances larger than a workshop's may have followed the errors of other causes to angles where the
        linearisation no longer holds. So the set is also fitted from an arm without tolerances, and the more probable
        fit is returned.
        """
        start = self.fit.with_unfitted_causes(self._sets.causes(one))
        fits = [start.with_tolerances(one.scales).with_tolerances(one.scales)]
        if max(one.scales.lengths, one.scales.angles) > 1.0:
            near = start.with_tolerances_from_nominal(one.scales.limited_to_workshop)
            fits.append(near.with_tolerances(_own_set(near, self._naming_cost).scales))
        return max(fits, key=self._worth)

    def _worth(self, fit: Fit) -> float:
        """Return the evidence of a fit's own causes minus the cost of naming them [nats]."""
        return _own_set(fit, self._naming_cost).net_evidence


def _own_set(fit: Fit, naming_cost: float) -> CauseSet:
    """Return the set of a fit's own causes.

    Args:
        naming_cost: minimum cost of naming one of them [nats].
    """
    parts = [part for cause in fit.causes for part in _by_parameter(Candidate(cause, 0.0, 1))]
    sets = CauseSets(fit, parts, naming_cost)
    return sets.of(sets.matching(fit.causes))


def _sets_of(fit: Fit, candidates: Sequence[Candidate], naming_cost: float) -> CauseSets:
    everything = [*(Candidate(cause, 0.0, 1) for cause in fit.causes), *candidates]
    return CauseSets(fit, [part for candidate in everything for part in _by_parameter(candidate)], naming_cost)


def _open_hypotheses(fit: Fit, hypotheses: Sequence[Effect]) -> list[Effect]:
    """Return the hypotheses that are neither causes of a fit, nor refine one, nor have a simpler name."""
    present = {cause.key for cause in fit.causes}
    absent = [one for one in hypotheses if one.key not in present and not one.kind.refines]
    return [one for one in absent if not has_simpler_name(one, hypotheses, fit.simulation)]


def _candidates_with_links(fit: Fit, absent: Sequence[Effect]) -> list[Candidate]:
    """Return the candidates, including joint offsets that are identifiable only without one of the fit's links.

    A link contains the offsets of the joints at both of its ends.
    """
    links = [cause for cause in fit.causes if cause.kind.in_parts]
    scan = Scan(fit, links)
    found = {one.effect.key: one for one in scan.candidates(absent)}
    for link in links:
        zeros = [one for one in absent if one.kind.is_zero and one.key not in found]
        found |= {one.effect.key: one for one in scan.without(link).candidates(zeros)}
    return list(found.values())


def _by_parameter(candidate: Candidate) -> list[Candidate]:
    """Return a candidate for each number of an effect that may have a subset of them; otherwise the candidate."""
    effect = candidate.effect
    if not effect.kind.in_parts:
        return [candidate]
    numbers = effect.with_free_amounts(None).amounts
    return [Candidate(replace(effect, free=(number,)), candidate.gain, 1) for number in numbers]


def _at_zero(candidate: Candidate) -> Candidate:
    """Return the candidate at zero amounts, about which it is linear."""
    if not candidate.effect.kind.is_linear:
        return candidate
    return Candidate(candidate.effect.with_amounts(0.0), candidate.gain, candidate.dof, candidate.trials)
