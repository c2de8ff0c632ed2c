"""Separate errors that have a named cause from those that have none."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.noise import wanders
from bodyschema.diagnosis.fit.worth import WorthSettings
from bodyschema.diagnosis.search.held_out import Blocks, held_out_errors, is_marker
from bodyschema.diagnosis.search.search import Search, describe, named
from bodyschema.diagnosis.search.together import beyond_tolerances, is_at_limit, tolerated
from bodyschema.diagnosis.unnamed.family_fits import Apart, UnnamedFamilies, Way
from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray


class _Settings:
    """Settings of the explanation.

    Sensitivity: each at 0.3 and 3 times changes nothing in three recordings with hidden errors, all of which are named.
    """

    margin = 8.0  # unnamed causes are accepted if they are more probable than named ones alone by this [nats]
    most_unnamed = 3
    slack = 1.2  # safety factor on the first-order gain of several unnamed causes
    number = 3.0  # cost of each parameter of a named cause when sets of causes are compared [nats]
    # The imperfect shape of large causes is not an unnamed cause, up to a share of all causes, and a larger share of
    # those that depend on the unobserved path between two readings.
    of_the_causes, of_the_way = 0.05, 0.12
    rest = 0.25  # a smaller share than this is a remainder
    as_good = 8.0  # causes that the same unnamed families explain as well, to within this, are dropped [nats]
    near = 30.0  # unnamed causes alone are refitted with scales of their own where they are no further behind [nats]
    slight = 0.02  # a smaller share of the held-out squares is a slight gain; 1 % was, and 40 % was not
    first, last = 3, 2  # of the fits along the search, this many first and last ones are tried beside unnamed causes
    beyond_doubt = 60.0  # rounded readings of a joint at rest cannot produce more evidence than this [nats]


@dataclass(frozen=True, eq=False)
class Explanation:
    """A set of named causes with a set of unnamed ones."""

    fit: Fit  # the fit with the named causes alone
    apart: Apart | None  # fit with the unnamed causes removed from the data; None if there is no unnamed cause
    worth: float  # log-evidence of the whole, comparable only with that of other explanations [nats]
    size: float = 0.0  # RMS change by the unnamed causes beyond the named ones, in units of the stated noise
    promise: float = -np.inf  # first-order gain of the best single unnamed cause beside the named ones [nats]
    counted: float = 1.0  # effective number of independent rows per row (0, 1]
    inexact: float = 0.0  # RMS change by an imperfect shape of the named causes, in the same units

    @property
    def wanders(self) -> bool:
        """True if neighbouring rows share an error beyond unnamed causes, larger than that of an imperfect shape."""
        fit = self.beside
        if fit.is_exact or not wanders(fit.correlation, fit.observations.motion.begins):
            return False
        return float(np.sqrt(np.square(fit.left).mean())) > self.inexact

    @property
    def beside(self) -> Fit:
        """The named causes, fitted beside the unnamed ones."""
        return self.fit if self.apart is None else self.apart.fit

    @property
    def unnamed_causes(self) -> tuple[Way, ...]:
        """The unnamed causes."""
        return () if self.apart is None else self.apart.chosen

    @property
    def is_specific(self) -> bool:
        return all(way.family.is_specific for way in self.unnamed_causes)


def explain(
    found: Fit, tried: Iterable[Fit], unnamed: UnnamedFamilies, search: Search, tell: Callable[[str], None]
) -> Explanation:
    """Keep the causes found, unless fewer of them with unnamed causes are clearly more probable.

    Functions of time, and of the joints during a walk, follow noise that is correlated between neighbouring rows. If
    noise is still correlated beside unnamed causes, only the effective number of independent rows counts.

    Args:
        found: the fit with all named causes of the search.
        tried: the fits along the search, the first without any cause.
    """
    path = list(tried)
    best = _compared(found, path, unnamed, search, 1.0)
    independence = best.beside.independence
    if best.apart is not None and independence < 1.0:
        best = _compared(found, path, unnamed, search, independence)
    if best.apart is not None:
        tell("something that none of the effects explains")
    return best


def _compared(found: Fit, path: Sequence[Fit], unnamed: UnnamedFamilies, search: Search, counted: float) -> Explanation:
    """Return the most probable explanation."""
    whole = _length(found, found.run.measured - path[0].run.measured)
    best = _with_unnamed(found, unnamed, search, counted)
    inexact = max(_Settings.of_the_causes * whole, _Settings.of_the_way * _length(found, changed_by_the_way(found)))
    if is_at_limit(found.background.scales):
        # The causes of an arm beyond workshop tolerances have not been found, so the remainder is not their shape.
        inexact = 0.0
    if best.apart is not None and (best.size < inexact or not unnamed.predicts(best.apart, found)):
        best = replace(best, apart=None, size=0.0)
    # Named causes that explain nearly everything are not given up for an explanation of the rest.
    is_rest = best.size < _Settings.rest * whole
    margin = _Settings.margin if is_rest else 0.0
    # Upper bound of an unnamed cause's gain: to first order it explains no more beside fewer causes.
    hope = counted * found.log_likelihood + best.promise if best.apart is None else np.inf
    looked_at = {(named(found.causes), found.background.scales)}
    for fit in [*path[: _Settings.first], *path[_Settings.first :][-_Settings.last :]]:
        looked = named(fit.causes), fit.background.scales
        if looked in looked_at:
            continue
        looked_at.add(looked)
        narrower = found.background.volume(found.noise.sigma) - fit.background.volume(found.noise.sigma)
        least = best.worth - (_Settings.as_good if best.unnamed_causes else 0.0)
        if hope + counted * narrower - cost_of_names(fit.causes, search) < least:
            continue
        other = _with_unnamed(fit, unnamed, search, counted, least)
        if other.apart is not None and not fit.causes and other.worth > best.worth - _Settings.near:
            # The scales of a fit without causes are those of an arm without unnamed causes, or a guess.
            other = _rescaled(other, other.apart, unnamed, search)
        clearly = margin if best.fit is found and not other.is_specific else 0.0
        better = other.worth > best.worth + clearly and not _is_as_good(best, other)
        better = better or _is_as_good(other, best)
        if other.apart is not None and better and unnamed.predicts(other.apart, found):
            best = other
    if best.apart is not None:
        # Linearised about the fit beside them: without them, tolerances follow them to distant values. Named causes are
        # not linearised again in this comparison, so neither is anything else.
        about = best.apart.fit.tolerating(tolerated(best.apart.fit).scales).to(best.fit.observations)
        best = _rescaled(best, best.apart, unnamed, search, about)
        best = _pruned(best, unnamed, search, rest=is_rest and best.fit is found)
    return replace(best, inexact=inexact)


def useful(explanation: Explanation, search: Search, blocks: Blocks, tell: Callable[[str], None]) -> Explanation:
    """Drop causes that are not worth naming, do not reduce the held-out error, or have impossible amounts.

    Larger tolerances may replace a link or a joint offset with no loss on held-out data, or a slight loss by chance.
    Such a cause stays if it is more probable than these tolerances.
    """
    fit = explanation.fit
    if explanation.unnamed_causes or fit.is_exact:
        return explanation
    while fit.causes:
        markers, error = is_marker(fit), _missed(fit, blocks)
        whole = max(float(error[markers].sum()), 1e-300)
        beyond = [beyond_tolerances(fit, cause, search.multiplicity) for cause in fit.causes]
        fewer = [search.beside(fit, cause).without for cause in fit.causes]
        # If tolerances are more probable than a cause, they get their own size without it.
        fewer = [
            one.tolerating(tolerated(one).scales) if cause.kind.rigid and is_beyond is False else one
            for one, cause, is_beyond in zip(fewer, fit.causes, beyond, strict=True)
        ]
        losses = [float((_missed(one, blocks) - error)[markers].sum()) for one in fewer]
        told = [
            # Negative backlash or compliance is impossible, even if it explains the data.
            cause.is_possible and search.worth(fit, cause) >= 0.0 and _is_told(cause, is_beyond, loss / whole)
            for cause, is_beyond, loss in zip(fit.causes, beyond, losses, strict=True)
        ]
        if all(told):
            break
        least = min((k for k, is_told in enumerate(told) if not is_told), key=losses.__getitem__)
        why = (
            "no gain on data not used in the fit" if losses[least] <= 0.0 else "something in its place is more probable"
        )
        tell(f"dropped {describe(fit.causes[least])}: {why}")
        # Tolerances grow by the part that the cause no longer explains.
        fit = fewer[least].tolerating(tolerated(fewer[least]).scales)
    return replace(explanation, fit=fit)


def _is_told(cause: Effect, beyond: bool | None, loss: float) -> bool:
    """Return True if a cause is worth naming; leaving it out adds the share `loss` to the held-out squares."""
    if cause.kind.rigid and beyond is not None and loss < _Settings.slight:
        # Every link is a little off, so a slight gain of one is chance.
        return beyond
    return loss > 0.0 or bool(beyond)


def _missed(fit: Fit, blocks: Blocks) -> FloatArray:
    """Return squared held-out errors (n,), in units of the stated noise.

    In metres, the rows with the least accurate measurements would dominate.
    """
    errors = held_out_errors(fit, blocks)[:, :, None]
    return np.square(fit.observations.whitened(errors)).sum(axis=(1, 2))


def _rescaled(
    best: Explanation, apart: Apart, unnamed: UnnamedFamilies, search: Search, about: Fit | None = None
) -> Explanation:
    """Refit with the tolerance scales found beside the unnamed causes, if that is more probable.

    Args:
        about: the named causes with these scales, linearised elsewhere.
    """
    scales = tolerated(apart.fit).scales
    again = _with_unnamed(about or best.fit.tolerating(scales), unnamed, search, best.counted)
    before = best.fit.background.scales
    gained = again.worth - best.worth - scales.doubt + (0.0 if before is None else before.doubt)
    return again if again.unnamed_causes and gained > 0.0 else best


def _is_as_good(fewer: Explanation, explanation: Explanation) -> bool:
    """Return True if fewer named causes do as well with a subset of the same unnamed causes."""
    if len(fewer.fit.causes) >= len(explanation.fit.causes):
        return False
    ways, needed = ({way.family.what for way in one.unnamed_causes} for one in (explanation, fewer))
    return bool(needed) and needed <= ways and fewer.worth > explanation.worth - _Settings.as_good


def changed_by_the_way(fit: Fit) -> FloatArray:
    """Return the change (n, 3) [m] by causes that depend on the path between two readings."""
    change = np.zeros_like(fit.residuals)
    for cause in fit.causes:
        if cause.kind.depends_on_path:
            change += fit.run.columns(cause)[:, :, cause.amounts] @ cause.values[cause.amounts]
    return change


def _length(fit: Fit, change: FloatArray) -> float:
    """Return the RMS size of a change (n, 3) [m], in units of the stated noise."""
    return float(np.sqrt(np.square(fit.observations.whitened(change[:, :, None])).mean()))


def _with_unnamed(
    fit: Fit, unnamed: UnnamedFamilies, search: Search, counted: float, least: float = -np.inf
) -> Explanation:
    """Add worthwhile unnamed causes one by one; stop when the total is unlikely to reach `least` [nats]."""
    apart: Apart | None = None
    promise, names = -np.inf, cost_of_names(fit.causes, search)
    while not fit.is_exact and (apart is None or len(apart.chosen) < _Settings.most_unnamed):
        here, chosen = (fit, ()) if apart is None else (apart.fit, apart.chosen)
        near = unnamed.nearest(here, chosen, counted)
        way, more = near[0]
        promise = more if apart is None else promise
        spent = 0.0 if apart is None else unnamed.cost(apart)
        worth = counted * here.log_likelihood - names - spent
        # Each remaining unnamed cause is worth hardly more than this one.
        if worth + _Settings.slack * (_Settings.most_unnamed - len(chosen)) * max(more, 0.0) < least:
            break
        doubted = more < _Settings.beyond_doubt
        if more < WorthSettings.named_nats or (doubted and unnamed.agreed(here, chosen, way) < 0.0):
            break
        tried = [unnamed.apart(fit, (*chosen, way), apart) for way, _ in near]
        apart = max(tried, key=lambda one: counted * one.fit.log_likelihood - unnamed.cost(one))
    if apart is None:
        return Explanation(fit, None, counted * fit.log_likelihood - names, promise=promise, counted=counted)
    worth = counted * apart.fit.log_likelihood - names - unnamed.cost(apart)
    return Explanation(fit, apart, worth, _length(fit, apart.predicted - fit.predicted), promise, counted)


def cost_of_names(causes: Iterable[Effect], search: Search) -> float:
    """Return the cost of naming causes, for the comparison of sets of causes [nats]."""
    return sum(_Settings.number * len(effect.amounts) + search.doubt_of(effect) for effect in causes)


def _pruned(explanation: Explanation, unnamed: UnnamedFamilies, search: Search, *, rest: bool) -> Explanation:
    """Remove causes not worth keeping beside unnamed ones; with a remainder, those that unnamed ones can replace."""
    for cause in explanation.fit.causes:
        least = explanation.worth - (_Settings.as_good if rest else WorthSettings.named_nats)
        fewer = without_one(explanation, cause, unnamed, search, least)
        redundant = _is_as_good(fewer, explanation) if rest else fewer.worth > least
        if fewer.unnamed_causes and redundant:
            explanation = fewer
    return explanation


def without_one(
    explanation: Explanation, cause: Effect, unnamed: UnnamedFamilies, search: Search, least: float = -np.inf
) -> Explanation:
    """Return the explanation without one of its causes; abandon it if it is unlikely to reach `least` [nats]."""
    return _with_unnamed(explanation.fit.without(cause), unnamed, search, explanation.counted, least)
