"""Which part of what is wrong has names, and which has none."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray

from .fit import Fit
from .held_out import Blocks, held_out_errors, is_marker
from .search import NAMED, Search, describe, named
from .together import tolerated
from .unknown import Apart, Unknowns, Way

# What has no name is taken for so much more probability than the named causes alone [nats].
_MARGIN = 8.0
_MOST_UNKNOWNS = 3
# What is said to first order of several ways may be exceeded so many times.
_SLACK = 1.2
# What a number of a named cause costs when sets of causes are compared [nats].
_NUMBER = 3.0
# What is left of large causes because their form is not quite theirs is nothing without a name: a share of them all,
# and a larger one of those that depend on the way between two readings, which nobody has seen.
_OF_THE_CAUSES, _OF_THE_WAY = 0.05, 0.12
_BY_THE_WAY = ("backlash", "settling", "camera_latency")
# Less than this share of all is a rest.
_REST = 0.25
# Causes that the same ways without a name can be, as probably to within this, are no causes [nats].
_AS_GOOD = 8.0
# So many causes more may come after the next.
_MANY = 10
# Of the fits on the way to all causes, these are asked whether they are better beside what has no name.
_FIRST, _LAST = 3, 2
# What is worth more than this no rounding of readings that stand still brings about [nats].
_BEYOND_DOUBT = 60.0


@dataclass(frozen=True, eq=False)
class Explanation:
    """A set of causes, and ways to differ that have no name.

    Attributes:
        fit: with the causes alone.
        apart: with what has no name taken away; None where there is nothing of the kind.
        worth: how probable they are together, in nats that count only beside those of others.
        size: how much what has no name adds to what the causes alone can say (RMS), in units of the stated noise.
        promise: what the best single way without a name is worth beside the causes, to first order [nats].
    """

    fit: Fit
    apart: Apart | None
    worth: float
    size: float = 0.0
    promise: float = -np.inf

    @property
    def beside(self) -> Fit:
        """The causes beside what has no name."""
        return self.fit if self.apart is None else self.apart.fit

    @property
    def unknown(self) -> tuple[Way, ...]:
        """What has no name."""
        return () if self.apart is None else self.apart.chosen

    @property
    def is_specific(self) -> bool:
        """Whether all that has no name is as specific as what has one."""
        return all(way.family.is_specific for way in self.unknown)


def explain(
    found: Fit, tried: Iterable[Fit], unknowns: Unknowns, search: Search, tell: Callable[[str], None]
) -> Explanation:
    """The causes found as they are, unless fewer of them and something without a name are clearly more probable.

    Args:
        found: with all causes that the search has named.
        tried: the fits on its way there, the first without any cause.
    """
    path = list(tried)
    whole = _length(found, found.run.measured - path[0].run.measured)
    best = _with_unknown(found, unknowns, search)
    inexact = max(_OF_THE_CAUSES * whole, _OF_THE_WAY * _length(found, changed_by_the_way(found)))
    if best.apart is not None and (best.size < inexact or not unknowns.predicts(best.apart, found)):
        best = replace(best, apart=None, size=0.0)
    # Where the causes explain by far the most, they are not given up for what explains the rest.
    is_rest = best.size < _REST * whole
    margin = _MARGIN if is_rest else 0.0
    # So much may a way be worth beside fewer causes at most: to first order it explains no more than beside them all.
    hope = found.log_likelihood + best.promise if best.apart is None else np.inf
    looked_at = {(named(found.causes), found.background.scales)}
    for fit in [*path[:_FIRST], *path[_FIRST:][-_LAST:]]:
        looked = named(fit.causes), fit.background.scales
        if looked in looked_at:
            continue
        looked_at.add(looked)
        narrower = found.background.volume(found.noise.sigma) - fit.background.volume(found.noise.sigma)
        if hope + narrower - cost_of_names(fit.causes, search) < best.worth - (_AS_GOOD if best.unknown else 0.0):
            continue
        other = _with_unknown(fit, unknowns, search, best.worth - (_AS_GOOD if best.unknown else 0.0))
        clearly = margin if best.fit is found and not other.is_specific else 0.0
        better = other.worth > best.worth + clearly and not _is_as_good(best, other)
        better = better or _is_as_good(other, best)
        if other.apart is not None and better and unknowns.predicts(other.apart, found):
            best = other
    if best.apart is not None:
        best = _rescaled(best, best.apart, unknowns, search)
        tell("something that none of the effects explains")
        best = _pruned(best, unknowns, search, rest=is_rest and best.fit is found)
    return best


def useful(explanation: Explanation, blocks: Blocks, tell: Callable[[str], None]) -> Explanation:
    """Drop causes that do not reduce the error on data not used in the fit."""
    fit = explanation.fit
    if explanation.unknown or fit.is_exact:
        return explanation
    while fit.causes:
        markers, error = is_marker(fit), _missed(fit, blocks)
        fewer = [fit.without(cause) for cause in fit.causes]
        losses = [float((_missed(one, blocks) - error)[markers].sum()) for one in fewer]
        least = int(np.argmin(losses))
        if losses[least] > 0.0:
            break
        tell(f"dropped {describe(fit.causes[least])}: no gain on data not used in the fit")
        fit = fewer[least]
    return replace(explanation, fit=fit)


def _missed(fit: Fit, blocks: Blocks) -> FloatArray:
    """Squared distances (n,) [m²] on rows not fitted."""
    return np.square(held_out_errors(fit, blocks)).sum(axis=1)


def _rescaled(best: Explanation, apart: Apart, unknowns: Unknowns, search: Search) -> Explanation:
    """With tolerances as large as they are beside what has no name, where that is more probable."""
    scales = tolerated(apart.fit).scales
    again = _with_unknown(best.fit.tolerating(scales), unknowns, search)
    before = best.fit.background.scales
    gained = again.worth - best.worth - scales.doubt + (0.0 if before is None else before.doubt)
    return again if again.unknown and gained > 0.0 else best


def needs_no_more_names(path: Sequence[Fit], worth: float, unknowns: Unknowns, search: Search) -> bool:
    """Whether one of the first fits of a search has all that can be named, beside something without a name.

    It has to be more probable than many more causes would be that are each worth as much as the next.

    Args:
        path: its fits, the last with all causes that it has named.
        worth: what the next of them would be worth [nats].
    """
    fit = path[-1]
    if unknowns.nearest(fit)[0][1] < _MANY * worth / _MOST_UNKNOWNS:
        return False
    least = fit.log_likelihood - cost_of_names(fit.causes, search) + _MANY * worth
    for first in path[:_FIRST]:
        other = _with_unknown(first, unknowns, search, least)
        if other.apart is not None and other.worth > least and search.is_complete(other.beside):
            return True
    return False


def _is_as_good(fewer: Explanation, explanation: Explanation) -> bool:
    """Whether fewer causes do as well beside ways without a name that are no others."""
    if len(fewer.fit.causes) >= len(explanation.fit.causes):
        return False
    ways, needed = ({way.family.what for way in one.unknown} for one in (explanation, fewer))
    return bool(needed) and needed <= ways and fewer.worth > explanation.worth - _AS_GOOD


def changed_by_the_way(fit: Fit) -> FloatArray:
    """What causes that depend on the way between two readings change (n, 3) [m]."""
    change = np.zeros_like(fit.residuals)
    for cause in fit.causes:
        if cause.name in _BY_THE_WAY:
            change += fit.run.columns(cause)[:, :, cause.amounts] @ cause.values[cause.amounts]
    return change


def _length(fit: Fit, change: FloatArray) -> float:
    """How large a change (n, 3) [m] is (RMS), in units of the stated noise."""
    return float(np.sqrt(np.square(fit.observations.whitened(change[:, :, None])).mean()))


def _with_unknown(fit: Fit, unknowns: Unknowns, search: Search, least: float = -np.inf) -> Explanation:
    """With the ways that are worth it, one after the other; given up where they will hardly be worth `least` [nats]."""
    apart: Apart | None = None
    promise, names = -np.inf, cost_of_names(fit.causes, search)
    while not fit.is_exact and (apart is None or len(apart.chosen) < _MOST_UNKNOWNS):
        here, chosen = (fit, ()) if apart is None else (apart.fit, apart.chosen)
        near = unknowns.nearest(here, chosen)
        way, more = near[0]
        promise = more if apart is None else promise
        spent = 0.0 if apart is None else unknowns.cost(apart)
        # The ways that are left are worth hardly more than this one each.
        if here.log_likelihood - names - spent + _SLACK * (_MOST_UNKNOWNS - len(chosen)) * max(more, 0.0) < least:
            break
        if more < NAMED or (more < _BEYOND_DOUBT and unknowns.agreed(here, chosen, way) < 0.0):
            break
        tried = [unknowns.apart(fit, (*chosen, way), apart) for way, _ in near]
        apart = max(tried, key=lambda one: one.fit.log_likelihood - unknowns.cost(one))
    if apart is None:
        return Explanation(fit, None, fit.log_likelihood - names, promise=promise)
    worth = apart.fit.log_likelihood - names - unknowns.cost(apart)
    return Explanation(fit, apart, worth, _length(fit, apart.predicted - fit.predicted), promise)


def cost_of_names(causes: Iterable[Effect], search: Search) -> float:
    """What causes cost where sets of causes are compared [nats]."""
    return sum(_NUMBER * len(effect.amounts) + search.doubt_of(effect) for effect in causes)


def _pruned(explanation: Explanation, unknowns: Unknowns, search: Search, *, rest: bool) -> Explanation:
    """Without causes that are not worth it beside what has no name; with a rest, without those that it can be."""
    for cause in explanation.fit.causes:
        fewer = without_one(explanation, cause, unknowns, search)
        redundant = _is_as_good(fewer, explanation) if rest else fewer.worth > explanation.worth - NAMED
        if fewer.unknown and redundant:
            return _pruned(fewer, unknowns, search, rest=rest)
    return explanation


def without_one(explanation: Explanation, cause: Effect, unknowns: Unknowns, search: Search) -> Explanation:
    """The explanation without one of its causes."""
    return _with_unknown(explanation.fit.without(cause), unknowns, search)
