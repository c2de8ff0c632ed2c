"""Separate errors that have a named cause from those that have none."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.net_evidence import WorthSettings
from bodyschema.diagnosis.fit.noise import is_autocorrelated
from bodyschema.diagnosis.search.held_out import Blocks, held_out_errors, is_marker
from bodyschema.diagnosis.search.joint_selection import estimated_tolerances, exceeds_tolerances, is_at_limit
from bodyschema.diagnosis.search.search import Search, cause_counts, describe
from bodyschema.diagnosis.unnamed.family_fits import FitWithDiscrepancy, PreparedFamily, UnnamedFamilies
from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray


class _Settings:
    """Settings of the explanation.

    Sensitivity: each at 0.3 and 3 times changes nothing in three recordings with hidden errors, all of which are named.
    """

    margin = 8.0  # unnamed causes are accepted if they are more probable than named ones alone by this [nats]
    max_unnamed = 3
    slack = 1.2  # safety factor on the first-order gain of several unnamed causes
    number = 3.0  # cost of each parameter of a named cause when sets of causes are compared [nats]
    # The imperfect shape of large causes is not an unnamed cause, up to a share of all causes, and a larger share of
    # those that depend on the unobserved path between two readings.
    cause_share, path_share = 0.05, 0.12
    rest = 0.25  # a smaller share than this is a remainder
    equivalent_within = 8.0  # causes that the same unnamed families explain as well, to within this, are dropped [nats]
    near = 30.0  # unnamed causes alone are refitted with scales of their own where they are no further behind [nats]
    slight = 0.02  # a smaller share of the held-out squares is a slight gain; 1 % was, and 40 % was not
    first, last = 3, 2  # of the fits along the search, this many first and last ones are tried beside unnamed causes
    beyond_doubt = 60.0  # rounded readings of a joint at rest cannot produce more evidence than this [nats]


@dataclass(frozen=True, eq=False)
class Explanation:
    """A set of named causes with a set of unnamed ones."""

    fit: Fit  # the fit with the named causes alone
    discrepancy_fit: (
        FitWithDiscrepancy | None
    )  # fit with the unnamed causes removed from the data; None if there is no unnamed cause
    net_evidence: float  # log-evidence of the whole, comparable only with that of other explanations [nats]
    size: float = 0.0  # RMS change by the unnamed causes beyond the named ones, in units of the stated noise
    best_unnamed_gain: float = -np.inf  # first-order gain of the best single unnamed cause beside the named ones [nats]
    independence: float = 1.0  # effective number of independent rows per row (0, 1]
    shape_error: float = 0.0  # RMS change by an imperfect shape of the named causes, in the same units

    @property
    def is_autocorrelated(self) -> bool:
        """True if neighbouring rows share an error beyond unnamed causes, larger than that of an imperfect shape."""
        fit = self.named_fit
        if fit.is_exact or not is_autocorrelated(fit.correlation, fit.observations.motion.begins):
            return False
        return float(np.sqrt(np.square(fit.weighted_residuals).mean())) > self.shape_error

    @property
    def named_fit(self) -> Fit:
        """The named causes, fitted beside the unnamed ones."""
        return self.fit if self.discrepancy_fit is None else self.discrepancy_fit.fit

    @property
    def unnamed_causes(self) -> tuple[PreparedFamily, ...]:
        """The unnamed causes."""
        return () if self.discrepancy_fit is None else self.discrepancy_fit.chosen

    @property
    def is_specific(self) -> bool:
        return all(prepared.family.is_specific for prepared in self.unnamed_causes)


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
    best = _best_explanation(found, path, unnamed, search, 1.0)
    independence = best.named_fit.independence
    if best.discrepancy_fit is not None and independence < 1.0:
        best = _best_explanation(found, path, unnamed, search, independence)
    if best.discrepancy_fit is not None:
        tell("something that none of the effects explains")
    return best


def _best_explanation(
    found: Fit, path: Sequence[Fit], unnamed: UnnamedFamilies, search: Search, independence: float
) -> Explanation:
    """Return the most probable explanation."""
    whole = _rms_change(found, found.run.measured - path[0].run.measured)
    best = _with_unnamed(found, unnamed, search, independence)
    shape_error = max(_Settings.cause_share * whole, _Settings.path_share * _rms_change(found, change_by_path(found)))
    if is_at_limit(found.background.scales):
        # The causes of an arm beyond workshop tolerances have not been found, so the remainder is not their shape.
        shape_error = 0.0
    if best.discrepancy_fit is not None and (
        best.size < shape_error or not unnamed.predicts(best.discrepancy_fit, found)
    ):
        best = replace(best, discrepancy_fit=None, size=0.0)
    # Named causes that explain nearly everything are not given up for an explanation of the rest.
    is_remainder = best.size < _Settings.rest * whole
    margin = _Settings.margin if is_remainder else 0.0
    # Upper bound of an unnamed cause's gain: to first order it explains no more beside fewer causes.
    upper_bound = (
        independence * found.log_likelihood + best.best_unnamed_gain if best.discrepancy_fit is None else np.inf
    )
    seen = {(cause_counts(found.causes), found.background.scales)}
    for fit in [*path[: _Settings.first], *path[_Settings.first :][-_Settings.last :]]:
        key = cause_counts(fit.causes), fit.background.scales
        if key in seen:
            continue
        seen.add(key)
        narrower = found.background.occam_cost(found.noise.sigma) - fit.background.occam_cost(found.noise.sigma)
        least = best.net_evidence - (_Settings.equivalent_within if best.unnamed_causes else 0.0)
        if upper_bound + independence * narrower - naming_cost(fit.causes, search) < least:
            continue
        other = _with_unnamed(fit, unnamed, search, independence, least)
        if (
            other.discrepancy_fit is not None
            and not fit.causes
            and other.net_evidence > best.net_evidence - _Settings.near
        ):
            # The scales of a fit without causes are those of an arm without unnamed causes, or a guess.
            other = _rescaled(other, other.discrepancy_fit, unnamed, search)
        clearly = margin if best.fit is found and not other.is_specific else 0.0
        better = other.net_evidence > best.net_evidence + clearly and not _is_equivalent(best, other)
        better = better or _is_equivalent(other, best)
        if other.discrepancy_fit is not None and better and unnamed.predicts(other.discrepancy_fit, found):
            best = other
    if best.discrepancy_fit is not None:
        # Linearised about the fit beside them: without them, tolerances follow them to distant values. Named causes are
        # not linearised again in this comparison, so neither is anything else.
        about = best.discrepancy_fit.fit.with_tolerances(estimated_tolerances(best.discrepancy_fit.fit).scales).to(
            best.fit.observations
        )
        best = _rescaled(best, best.discrepancy_fit, unnamed, search, about)
        best = _prune(best, unnamed, search, rest=is_remainder and best.fit is found)
    return replace(best, shape_error=shape_error)


def useful(explanation: Explanation, search: Search, blocks: Blocks, tell: Callable[[str], None]) -> Explanation:
    """Drop causes that are not worth naming, do not reduce the held-out error, or have impossible amounts.

    Larger tolerances may replace a link or a joint offset with no loss on held-out data, or a slight loss by chance.
    Such a cause stays if it is more probable than these tolerances.
    """
    fit = explanation.fit
    if explanation.unnamed_causes or fit.is_exact:
        return explanation
    while fit.causes:
        markers, error = is_marker(fit), _squared_errors(fit, blocks)
        whole = max(float(error[markers].sum()), 1e-300)
        beyond = [exceeds_tolerances(fit, cause, search.multiplicity) for cause in fit.causes]
        fewer = [search.leave_one_out(fit, cause).without for cause in fit.causes]
        # If tolerances are more probable than a cause, they get their own size without it.
        fewer = [
            one.with_tolerances(estimated_tolerances(one).scales) if cause.kind.rigid and is_beyond is False else one
            for one, cause, is_beyond in zip(fewer, fit.causes, beyond, strict=True)
        ]
        losses = [float((_squared_errors(one, blocks) - error)[markers].sum()) for one in fewer]
        is_worth = [
            # Negative backlash or compliance is impossible, even if it explains the data.
            cause.is_valid
            and search.net_evidence(fit, cause) >= 0.0
            and _is_worth_reporting(cause, is_beyond, loss / whole)
            for cause, is_beyond, loss in zip(fit.causes, beyond, losses, strict=True)
        ]
        if all(is_worth):
            break
        weakest = min((k for k, is_reported in enumerate(is_worth) if not is_reported), key=losses.__getitem__)
        why = (
            "no gain on data not used in the fit"
            if losses[weakest] <= 0.0
            else "something in its place is more probable"
        )
        tell(f"dropped {describe(fit.causes[weakest])}: {why}")
        # Tolerances grow by the part that the cause no longer explains.
        fit = fewer[weakest].with_tolerances(estimated_tolerances(fewer[weakest]).scales)
    return replace(explanation, fit=fit)


def _is_worth_reporting(cause: Effect, beyond: bool | None, loss: float) -> bool:
    """Return True if a cause is worth naming; leaving it out adds the share `loss` to the held-out squares."""
    if cause.kind.rigid and beyond is not None and loss < _Settings.slight:
        # Every link is a little off, so a slight gain of one is chance.
        return beyond
    return loss > 0.0 or bool(beyond)


def _squared_errors(fit: Fit, blocks: Blocks) -> FloatArray:
    """Return squared held-out errors (n,), in units of the stated noise.

    In metres, the rows with the least accurate measurements would dominate.
    """
    errors = held_out_errors(fit, blocks)[:, :, None]
    return np.square(fit.observations.whitened(errors)).sum(axis=(1, 2))


def _rescaled(
    best: Explanation,
    discrepancy_fit: FitWithDiscrepancy,
    unnamed: UnnamedFamilies,
    search: Search,
    about: Fit | None = None,
) -> Explanation:
    """Refit with the tolerance scales found beside the unnamed causes, if that is more probable.

    Args:
        about: the named causes with these scales, linearised elsewhere.
    """
    scales = estimated_tolerances(discrepancy_fit.fit).scales
    again = _with_unnamed(about or best.fit.with_tolerances(scales), unnamed, search, best.independence)
    before = best.fit.background.scales
    gained = (
        again.net_evidence
        - best.net_evidence
        - scales.prior_penalty
        + (0.0 if before is None else before.prior_penalty)
    )
    return again if again.unnamed_causes and gained > 0.0 else best


def _is_equivalent(fewer: Explanation, explanation: Explanation) -> bool:
    """Return True if fewer named causes do as well with a subset of the same unnamed causes."""
    if len(fewer.fit.causes) >= len(explanation.fit.causes):
        return False
    families, needed = ({prepared.family.what for prepared in one.unnamed_causes} for one in (explanation, fewer))
    return (
        bool(needed)
        and needed <= families
        and fewer.net_evidence > explanation.net_evidence - _Settings.equivalent_within
    )


def change_by_path(fit: Fit) -> FloatArray:
    """Return the change (n, 3) [m] by causes that depend on the path between two readings."""
    change = np.zeros_like(fit.residuals)
    for cause in fit.causes:
        if cause.kind.depends_on_path:
            change += fit.run.columns(cause)[:, :, cause.amounts] @ cause.values[cause.amounts]
    return change


def _rms_change(fit: Fit, change: FloatArray) -> float:
    """Return the RMS size of a change (n, 3) [m], in units of the stated noise."""
    return float(np.sqrt(np.square(fit.observations.whitened(change[:, :, None])).mean()))


def _with_unnamed(
    fit: Fit, unnamed: UnnamedFamilies, search: Search, independence: float, least: float = -np.inf
) -> Explanation:
    """Add worthwhile unnamed causes one by one; stop when the total is unlikely to reach `least` [nats]."""
    discrepancy_fit: FitWithDiscrepancy | None = None
    best_unnamed_gain, names = -np.inf, naming_cost(fit.causes, search)
    while not fit.is_exact and (discrepancy_fit is None or len(discrepancy_fit.chosen) < _Settings.max_unnamed):
        here, chosen = (fit, ()) if discrepancy_fit is None else (discrepancy_fit.fit, discrepancy_fit.chosen)
        near = unnamed.nearest(here, chosen, independence)
        prepared, more = near[0]
        best_unnamed_gain = more if discrepancy_fit is None else best_unnamed_gain
        discrepancy_cost = 0.0 if discrepancy_fit is None else unnamed.cost(discrepancy_fit)
        net_evidence = independence * here.log_likelihood - names - discrepancy_cost
        # Each remaining unnamed cause is worth hardly more than this one.
        if net_evidence + _Settings.slack * (_Settings.max_unnamed - len(chosen)) * max(more, 0.0) < least:
            break
        doubted = more < _Settings.beyond_doubt
        if more < WorthSettings.named_nats or (doubted and unnamed.evidence_from_blocks(here, chosen, prepared) < 0.0):
            break
        tried = [unnamed.discrepancy_fit(fit, (*chosen, prepared), discrepancy_fit) for prepared, _ in near]
        discrepancy_fit = max(tried, key=lambda one: independence * one.fit.log_likelihood - unnamed.cost(one))
    if discrepancy_fit is None:
        return Explanation(
            fit,
            None,
            independence * fit.log_likelihood - names,
            best_unnamed_gain=best_unnamed_gain,
            independence=independence,
        )
    net_evidence = independence * discrepancy_fit.fit.log_likelihood - names - unnamed.cost(discrepancy_fit)
    return Explanation(
        fit,
        discrepancy_fit,
        net_evidence,
        _rms_change(fit, discrepancy_fit.predicted - fit.predicted),
        best_unnamed_gain,
        independence,
    )


def naming_cost(causes: Iterable[Effect], search: Search) -> float:
    """Return the cost of naming causes, for the comparison of sets of causes [nats]."""
    return sum(_Settings.number * len(effect.amounts) + search.multiplicity_penalty_of(effect) for effect in causes)


def _prune(explanation: Explanation, unnamed: UnnamedFamilies, search: Search, *, rest: bool) -> Explanation:
    """Remove causes not worth keeping beside unnamed ones; with a remainder, those that unnamed ones can replace."""
    for cause in explanation.fit.causes:
        least = explanation.net_evidence - (_Settings.equivalent_within if rest else WorthSettings.named_nats)
        fewer = without_cause(explanation, cause, unnamed, search, least)
        redundant = _is_equivalent(fewer, explanation) if rest else fewer.net_evidence > least
        if fewer.unnamed_causes and redundant:
            explanation = fewer
    return explanation


def without_cause(
    explanation: Explanation, cause: Effect, unnamed: UnnamedFamilies, search: Search, least: float = -np.inf
) -> Explanation:
    """Return the explanation without one of its causes; abandon it if it is unlikely to reach `least` [nats]."""
    return _with_unnamed(explanation.fit.without(cause), unnamed, search, explanation.independence, least)
