"""Find the errors of a simulation from a recording."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bodyschema.diagnosis.assess.explanation import (
    Explanation,
    changed_by_the_way,
    cost_of_names,
    explain,
    useful,
    without_one,
)
from bodyschema.diagnosis.assess.residual_structure import ResidualStructure, residual_structure
from bodyschema.diagnosis.assess.rivals import Standing, standings
from bodyschema.diagnosis.assess.shares import Shares, shares
from bodyschema.diagnosis.assess.stored import is_better_with, stored
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.background import Scales
from bodyschema.diagnosis.fit.fit import Fit, fitted
from bodyschema.diagnosis.fit.instrument import instrument_factor, reshaped
from bodyschema.diagnosis.fit.noise import correlation, wanders
from bodyschema.diagnosis.fit.observations import IntArray, Observations
from bodyschema.diagnosis.fit.worth import WorthSettings
from bodyschema.diagnosis.search.drives import with_small_ripples
from bodyschema.diagnosis.search.held_out import Added, Blocks, added, gain_percent, held_out_errors, is_marker
from bodyschema.diagnosis.search.hypotheses import Hypotheses
from bodyschema.diagnosis.search.scan import Candidate, Scan, moment_again
from bodyschema.diagnosis.search.search import Search, are_a_description
from bodyschema.diagnosis.search.together import Tolerated, in_place_of_tolerances, together, tolerated
from bodyschema.diagnosis.unnamed.family_fits import UnnamedFamilies
from bodyschema.diagnosis.unnamed.rattle import Rattle, likelihood, rattle, rattle_beside
from bodyschema.effects import Effect, Identity, Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording

from .stages import RIVALS, SEARCH, SETS, UNNAMED, Stages

Told = Callable[[str], None]


class DiagnosisSettings:
    """Settings of the diagnosis.

    Sensitivity, each at 0.3 and 3 times over seven recordings with hidden errors: `same_scale` and `rescaled`, with
    which tolerances are fitted again, change one and three reports; `little` changes a word. The others change nothing
    there; `most_spent`, `same_noise`, `most_rows` and `run` were tried on three of them alone, none a long one.
    """

    fewest_outliers = 3  # fewer outliers than this are not a finding
    outliers_named = 15.0  # smallest evidence gain for reporting outliers [nats]
    mostly = 0.8  # outliers count as motion-related if they occur on faster rows at least this often
    # Farther off than this, in units of the change by the path between two readings, the path cannot be the reason.
    by_so_much = 4.0
    # Smallest change of the tolerance scales (in logarithms) that triggers a refit, and the maximum of refits.
    same_scale, rescaled = 0.25, 3
    rattled = 2  # fits with the play of a loose marker; the first tells the noise beside it
    little = 0.9  # squares reduced by less than to this share are reduced a little
    most_spent = 0.9  # the fit absorbs at most this share of the noise
    same_noise = 0.1  # smallest change of the instrument's noise (in logarithms) that triggers a refit
    # In more than twice as many rows, causes are sought in runs of neighbouring rows, and fitted to all of them.
    most_rows, run = 1000, 50
    # Rows before which the state is unknown are left out while most rows remain: a false jump may stand in for them.
    most_doubtful = 0.5


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The errors found in a simulation, with everything that a report shows about them."""

    hypotheses: Hypotheses  # the effects that were tested, and the reasons why others were not
    nominal: Fit  # the unchanged simulation
    aligned: Fit  # fit of the parameters that robot.toml does not know
    geometry: Fit  # fit with all lengths, axes, joint offsets, the tool and the camera's pose free
    extended: Fit  # fit with the causes, the tolerances, and the smooth model of the unnamed causes
    alone: Fit  # the same without the smooth model
    stored: Fit  # the part of it that is surely better on another recording, which is written to extended.toml
    tolerated: Tolerated  # sizes of the tolerances
    standings: tuple[Standing, ...]  # assessment of each cause against its rivals
    left: ResidualStructure  # residual structure that no effect fits
    blocks: Blocks  # blocks of time for held-out errors
    seed: int  # seed of the resampling
    part: Observations | None = None  # the observations used in the search for causes; None for all
    ended_early: bool = False  # True if the causes only describe the error, as there are too many

    @property
    def causes(self) -> tuple[Effect, ...]:
        return self.extended.causes

    @cached_property
    def errors(self) -> dict[str, FloatArray]:
        """Measured minus predicted (n, 3) [m] by each simulation, on held-out rows."""
        fits = {"nominal": self.nominal, "aligned": self.aligned, "geometry": self.geometry}
        errors = {name: held_out_errors(fit, self.blocks) for name, fit in fits.items()}
        is_complete = self.stored is self.extended
        return errors | {"extended": self.complete_errors if is_complete else held_out_errors(self.stored, self.blocks)}

    @cached_property
    def complete_errors(self) -> FloatArray:
        """Measured minus predicted (n, 3) [m] by all findings, stored or not, on held-out rows."""
        return self._extended_errors(self.extended)

    @cached_property
    def without_model(self) -> FloatArray | None:
        """Held-out distances (n,) [m] with causes and tolerances but no smooth model; None if there is none."""
        if self.left.model is None or self.left.model.stored is None or self.leaves_out:
            return None
        return np.linalg.norm(held_out_errors(self.alone, self.blocks), axis=1)

    @cached_property
    def modelled(self) -> FloatArray:
        """Change of the predictions (n, 3) [m] by the model of unnamed causes, with everything else refitted."""
        if self.left.model is None:
            return np.zeros_like(self.extended.predicted)
        return self.extended.predicted + self.left.model.unstored - self.alone.predicted

    def _extended_errors(self, fit: Fit) -> FloatArray:
        """Return measured minus predicted (n, 3) [m] on rows held out from causes and smooth model."""
        if self.left.model is None:
            return held_out_errors(fit, self.blocks)
        return fit.observations.x - fit.predicted + self.left.model.unseen

    @cached_property
    def leaves_out(self) -> bool:
        """True if extended.toml leaves out parts that reduce the error here considerably."""
        squares = [np.square(errors[self.markers]).sum() for errors in (self.complete_errors, self.errors["extended"])]
        return bool(squares[0] < DiagnosisSettings.little * squares[1])

    @cached_property
    def held_out(self) -> dict[str, FloatArray]:
        """Lengths (n,) [m] of `errors`."""
        return {name: np.linalg.norm(error, axis=1) for name, error in self.errors.items()}

    @cached_property
    def markers(self) -> np.ndarray:
        """True for fixes (n,) that are probably the marker."""
        return is_marker(self.extended)

    @property
    def outliers(self) -> int:
        return int(self._off.sum())

    @property
    def _off(self) -> np.ndarray:
        return ~self.markers & self.extended.observations.trusted & ~self.extended.doubtful()

    @property
    def outliers_are_found(self) -> bool:
        """Return True if outliers are numerous and large enough to be a finding."""
        worth = self.extended.noise.log_likelihood - self.extended.without_outliers
        named = self.outliers >= DiagnosisSettings.fewest_outliers and worth > DiagnosisSettings.outliers_named
        return named and not self._off_where_fast() and not self._off_by_what_is_inexact()

    def _off_by_what_is_inexact(self) -> bool:
        """Return True if the outliers are no farther off than roughly known influences can explain.

        These are the path between two readings, which was not observed, and unnamed causes.
        """
        fit = self.extended
        changes = [changed_by_the_way(fit)]
        if self.left.model is not None:
            changes.append(self.left.model.explained)
        squares = np.square(fit.observations.whitened(np.stack(changes, axis=2))).sum(axis=1).mean(axis=0)
        off = np.square(fit.residuals[self._off]).sum(axis=1)
        return bool(np.median(off) < DiagnosisSettings.by_so_much**2 * squares.sum())

    def _off_where_fast(self) -> bool:
        """Return True if most outliers are at the fastest rows; the motion is then poorly modelled."""
        motion = self.extended.observations.motion
        steps = np.linalg.norm(motion.moves, axis=1)
        duration = np.ones(len(motion)) if motion.t is None else np.append(np.inf, np.diff(motion.t))
        speed = steps / np.maximum(duration, 1e-9)
        on, off = self.markers, self._off
        return max(_exceeds(v[off], v[on]) for v in (steps, speed)) > DiagnosisSettings.mostly

    def gain(self) -> tuple[float, tuple[float, float]]:
        """Return the reduction of the RMS from aligned to extended [%], with its 95 % interval on new poses."""
        return self._gain(np.where(self.markers, 1.0, 0.0))

    def gain_with_outliers(self) -> tuple[float, tuple[float, float]]:
        """Return the same over all fixes, including those that are not the marker, whose error no model reduces."""
        return self._gain(np.ones(len(self.markers)))

    def _gain(self, weights: FloatArray) -> tuple[float, tuple[float, float]]:
        before, after = (weights * self.held_out[name] for name in ("aligned", "extended"))
        return gain_percent(before, after, self.blocks, self.seed)

    @cached_property
    def worse_without(self) -> dict[Identity, float]:
        """Held-out sum of squares without each of the causes, divided by that with all."""
        if self.part is not None and self.left.model is None:
            fit, blocks = self.sought, Blocks.cut(len(self.part))
            whole, fewer = (
                held_out_errors(fit, blocks),
                {c: held_out_errors(fit.without(c), blocks) for c in fit.causes},
            )
            markers = is_marker(fit)
        else:
            whole, markers = self.complete_errors, self.markers
            fewer = {c: self._extended_errors(self.extended.without(c)) for c in self.causes}
        square = max(float(np.square(whole[markers]).sum()), 1e-300)
        return {cause.identity: float(np.square(errors[markers]).sum()) / square for cause, errors in fewer.items()}

    @cached_property
    def shares(self) -> Shares:
        unnamed = None if self.left.model is None else self.left.model.explained
        return shares(self.aligned, self.extended, self.markers, unnamed)

    @cached_property
    def noise(self) -> FloatArray:
        """Noise covariances (n, 3, 3) [m²], from the residuals of the complete model.

        If neighbouring rows share nearly all of their residuals, only the rest is noise: half the square of their
        differences.
        """
        fit, kept = self.extended, self.markers
        if self.left.model is not None:
            # Large tolerances moved into the simulation are right to first order only.
            fit = self.left.model.fit
        unstored = 0.0 if self.left.model is None else self.left.model.unstored
        left = fit.observations.x - fit.predicted - unstored
        motion = fit.observations.motion
        shared = correlation(np.where(kept[:, None], left, 0.0), motion.begins)
        shared = shared if self.left.rattle is None and wanders(shared, motion.begins) else 0.0
        left = left[kept]
        roots = np.linalg.inv(fit.observations.whitening)
        stated = roots @ np.swapaxes(roots, 1, 2)
        # Scale the stated noise to the size of the residuals, corrected for the degrees of freedom of the fit.
        spent = min(fit.background.spent(fit.noise.sigma) / max(left.size, 1), DiagnosisSettings.most_spent)
        size = np.square(left).sum() / np.trace(stated[kept], axis1=1, axis2=2).sum() / (1.0 - spent) * (1.0 - shared)
        # The play of a loose marker is not noise.
        return float(size) * fit.observations.own

    @cached_property
    def with_tolerances_alone(self) -> FloatArray | None:
        """Held-out distances (n,) [m] with tolerances and no cause; None if no tolerance is detected."""
        if not self.causes or not self.tolerated.seen.any():
            return None
        return np.linalg.norm(held_out_errors(self.extended.with_causes([]), self.blocks), axis=1)

    @cached_property
    def sought(self) -> Fit:
        """The complete fit over the rows used in the search for causes."""
        return self.extended if self.part is None else self.extended.over(self.part)

    @cached_property
    def in_place_of_tolerances(self) -> list[tuple[Effect, float]]:
        """Possible causes instead of tolerances of several times a workshop's, with probabilities."""
        return [] if self.left.is_there else in_place_of_tolerances(self.sought, self.hypotheses.effects)

    @cached_property
    def rejected(self) -> list[tuple[Candidate, Added]]:
        """Rejected hypotheses, each with its best fit beside the causes."""
        present = {cause.key for cause in self.causes}
        fit = self.sought
        blocks = self.blocks if self.part is None else Blocks.cut(len(self.part))
        candidates = Scan(fit).candidates(h for h in self.hypotheses.effects if h.key not in present)
        return list(zip(candidates, added(fit, candidates, blocks), strict=True))


def diagnose(
    recording: Recording,
    simulation: Simulation,
    *,
    only: Collection[str] = (),
    without: Collection[str] = (),
    seed: int = 0,
    blocks: Blocks | None = None,
    tell: Told = lambda _: None,
) -> Diagnosis:
    """Find the errors of `simulation` from a recording.

    Args:
        only, without: names of effects to test, all by default, and not to test.
        seed: seed of the resampling.
        blocks: blocks of held-out rows; blocks of time by default.
        tell: called with the stage and the approximate share of the work done.
    """
    observations = Observations.of(recording, simulation)
    hypotheses = Hypotheses.of(simulation, observations, only=only, without=without)
    told = Stages(tell)
    told.begin(SETS)
    told(f"{len(hypotheses.effects)} hypotheses")
    blocks = blocks or Blocks.cut(len(recording))
    rows = _part_of(observations.motion.begins)
    if len(rows) == len(observations):
        found = _found(observations, simulation, hypotheses.effects, blocks, seed, told)
    else:
        part = _found(observations.some(rows), simulation, hypotheses.effects, Blocks.cut(len(rows)), seed, told)
        told(f"the same in all {len(observations)} rows")
        found = part.over(observations, simulation)
    start, explanation, search = found.start, found.explanation, found.search
    if found.loose is not None:
        # If the side depends on the pose, a model of this dependence predicts better.
        start = aligned(start.observations.whole, simulation)
    left = found.left(blocks)
    fit = (explanation.fit if left.model is None else left.model.fit).settled()
    made = tolerated(fit)
    if left.model is None and not made.seen.any():
        fit = fit.untolerated()
    return Diagnosis(
        hypotheses=hypotheses,
        nominal=fitted(start.observations, simulation, len(simulation.effects)),
        aligned=start,
        geometry=_geometry(start),
        extended=fit,
        alone=explanation.fit,
        stored=fit if fit.is_exact else _stored(start, explanation.fit, fit, left, blocks),
        tolerated=made,
        standings=tuple(found.standings),
        left=left,
        blocks=blocks,
        seed=seed,
        part=None if found.part is None else found.part.start.observations,
        ended_early=search.ended_early or are_a_description(fit.causes),
    )


@dataclass(frozen=True, eq=False)
class _SearchResult:
    """Result of a search in some observations."""

    start: Fit  # fit of the parameters that robot.toml does not know
    search: Search
    unnamed: UnnamedFamilies
    explanation: Explanation
    standings: Sequence[Standing]  # assessment of each cause against its rivals
    loose: Rattle | None  # play of the marker; None for one that is fixed
    is_reshaped: bool  # True if the noise has another shape than stated
    part: _SearchResult | None = None  # result for a part of the observations; None if all were searched

    def left(self, blocks: Blocks) -> ResidualStructure:
        # With many rows, all families would take much memory to find nothing new.
        asked = self if self.part is None or self.explanation.unnamed_causes else self.part
        return residual_structure(asked.explanation, asked.unnamed, blocks, self.loose)

    def over(self, observations: Observations, simulation: Simulation) -> _SearchResult:
        """Return the same causes, fitted to all observations, of which these were a part.

        No further causes are searched for: no model is exact, and in many rows its smallest error looks like a cause
        (Miller and Dunson 2019). Moments are searched for again, since they may lie between the parts.
        """
        before = self.start.observations
        fit = self.explanation.fit.over(observations.with_factor(before.stated_factor))
        observations, loose = fit.observations, self.loose
        if self.is_reshaped:
            observations = reshaped(fit) or observations
        if before.doubtful is not None:
            observations = observations.without(_left_out(fit))
        if loose is not None:
            loose = rattle(fit) or loose
            observations = observations.with_rattle(loose.ratio, loose.ways_of(fit))
        fit, stands = fit.to(observations), list(self.standings)
        for k in range(len(stands)):
            moment = _moment_anew(fit, fit.causes[k], before.motion.clock) if fit.causes[k].kind.begins else None
            if moment is not None:
                causes = [*fit.causes]
                causes[k] = moment.effect
                fit, stands[k] = fit.with_causes(causes), replace(stands[k], itself=moment)
        again = replace(self, explanation=replace(self.explanation, fit=fit), standings=stands, loose=loose, part=self)
        return again.of(observations, simulation)

    def of(self, observations: Observations, simulation: Simulation) -> _SearchResult:
        """Return the same causes, fitted to other observations of the same motion."""
        start = aligned(observations, simulation)
        unnamed, fit = UnnamedFamilies(start), self.explanation.fit.to(observations)
        chosen = unnamed.again(self.explanation.unnamed_causes)
        apart = unnamed.apart(fit, chosen) if chosen else None
        return replace(self, start=start, unnamed=unnamed, explanation=replace(self.explanation, fit=fit, apart=apart))


def _part_of(begins: NDArray[np.bool_]) -> IntArray:
    """Return the rows in which to search for causes: all, or equal runs that are spread over a long recording.

    Each run is the one of its stretch with the fewest breaks: after a break, the side of a joint's backlash is
    unknown.

    Args:
        begins: (n,), True in the first row after each break.
    """
    rows = len(begins)
    if rows <= 2 * DiagnosisSettings.most_rows:
        return np.arange(rows)
    breaks = np.convolve(begins[1:], np.ones(DiagnosisSettings.run - 1), "valid")
    runs = DiagnosisSettings.most_rows // DiagnosisSettings.run
    firsts = np.linspace(0, rows - DiagnosisSettings.run, runs).astype(np.intp)
    for k, (first, after) in enumerate(pairwise(firsts.tolist())):
        firsts[k] += np.argmin(breaks[first : after - DiagnosisSettings.run + 1])
    return (firsts[:, None] + np.arange(DiagnosisSettings.run)).ravel()


def _moment_anew(fit: Fit, cause: Effect, searched: FloatArray) -> Candidate | None:
    """Return a cause that begins at a moment with its best moment, which was searched for only at some times (m,)."""
    clock, after = fit.observations.motion.clock, int(np.searchsorted(searched, cause.values[-1]))
    between = (clock > searched[max(after - 1, 0)]) & (clock < searched[min(after, len(searched) - 1)])
    return moment_again(fit, cause, between)


def _left_out(fit: Fit) -> NDArray[np.bool_]:
    """Return the rows (n,) to leave out because their history is not known well enough.

    If they are too many, return only the first ones; the arm is then assumed to go straight from each run to the next.
    """
    rows = fit.doubtful()
    return rows if rows.mean() <= DiagnosisSettings.most_doubtful else fit.doubtful_at_first


def _found(
    observations: Observations,
    simulation: Simulation,
    hypotheses: Sequence[Effect],
    blocks: Blocks,
    seed: int,
    told: Stages,
) -> _SearchResult:
    """Search for the causes in some observations, and test for unnamed causes."""
    start = aligned(observations, simulation)
    search = Search(hypotheses, told)
    begun = start if start.is_exact else together(start, hypotheses, told)
    told.begin(SEARCH, SETS)
    # The most probable set gives the noise, and the rows to leave out, before the long search.
    begun, start = _refitted(begun, start, simulation)
    unnamed = UnnamedFamilies(start)
    extended = search.run(begun) if start.is_exact else _searched(begun, search)
    other_shape = None if start.is_exact else reshaped(extended)
    if other_shape is not None and (
        rattle(extended) or explain(extended, search.path, unnamed, search, told).unnamed_causes
    ):
        # The remainder is not only noise.
        other_shape = None
    again, start = (extended, start) if search.ended_early else _refitted(extended, start, simulation, other_shape)
    if again is not extended:
        unnamed = UnnamedFamilies(start)
        extended = _searched(again, search)
    told.begin(UNNAMED, SEARCH)
    explanation = explain(extended, search.path, unnamed, search, told)
    # A loose marker does not slip, and changes of its side may have been named jumps and bumps.
    steady = [cause for cause in extended.causes if cause.kind.stage != "tool" and not cause.kind.begins]
    # Likelihoods can only be compared over the same rows.
    bare = begun.with_causes([]).to(start.observations)
    fits = [start, bare, *([extended.with_causes(steady)] if steady else [])]
    loose = None if start.is_exact else _loose(explanation, fits, search)
    for _ in range(DiagnosisSettings.rattled if loose is not None else 0):
        assert loose is not None
        told(loose.what)
        # Start again: causes may have been named because of the play, and the noise is smaller without it.
        # A loose marker has no offset of its own, and does not slip.
        fixed = [effect for effect in hypotheses if effect.kind.stage != "tool"]
        search = Search(fixed, told)
        start = aligned(loose.taken_out_of(start.observations), simulation)
        unnamed = UnnamedFamilies(start)
        extended = search.run(start) if start.is_exact else _searched(together(start, fixed, told), search)
        explanation = explain(extended, search.path, unnamed, search, told)
        loose = rattle(extended) or loose
    explanation = useful(explanation, search, blocks, told)
    told.begin(RIVALS, UNNAMED)
    stands = standings(explanation.beside, search, blocks, seed, None if explanation.unnamed_causes else unnamed)
    while explanation.unnamed_causes and any(standing.probability < 0.5 for standing in stands):
        weakest = int(np.argmin([standing.probability for standing in stands]))
        fewer = without_one(explanation, explanation.fit.causes[weakest], unnamed, search)
        if not fewer.unnamed_causes:
            break
        explanation = fewer
        stands = standings(explanation.beside, search, blocks, seed)
    found = _SearchResult(start, search, unnamed, explanation, stands, loose, other_shape is not None)
    if loose is None:
        return found
    # No simulation predicts the side on which the marker lies.
    whole = start.observations.without_play(np.zeros_like(start.observations.x)).without(_left_out(explanation.fit))
    return found.of(whole.with_rattle(loose.ratio, loose.ways), simulation)


def _loose(explanation: Explanation, fits: Sequence[Fit], search: Search) -> Rattle | None:
    """Return the play of a loose marker if its two sides beside one of the fits are more probable than everything else.

    A joint's error can move the marker along one line as well, but then the joints or the path predict its position.
    """
    beside, found = explanation.beside, [(rattle_beside(fit), cost_of_names(fit.causes, search)) for fit in fits]
    other = explanation.worth - explanation.counted * beside.log_likelihood + likelihood(beside)
    worths = [(play.likelihood - names - other, play) for play, names in found if play is not None]
    worth, play = max(worths, key=lambda one: one[0], default=(-np.inf, None))
    return play if worth > WorthSettings.named_nats else None


def _refitted(fit: Fit, start: Fit, simulation: Simulation, shape: Observations | None = None) -> tuple[Fit, Fit]:
    """Refit with the estimated noise and without the rows that the causes leave out; return the fit if nothing changes.

    Args:
        start: fit of the parameters unknown to robot.toml, returned with the same observations.
        shape: the observations with another shape of the noise; None if it stays.
    """
    observations = fit.observations
    factor, left_out = instrument_factor(fit), _left_out(fit)
    before = np.zeros_like(left_out) if observations.doubtful is None else observations.doubtful
    # Other amounts of the same causes change few rows.
    other_rows = (left_out ^ before).sum() > (left_out & before).sum()
    other_noise = abs(np.log(factor / observations.stated_factor)) > DiagnosisSettings.same_noise
    if fit.is_exact or not (other_rows or other_noise or shape is not None):
        return fit, start
    observations = (shape or observations).with_factor(factor).without(left_out)
    again = fit.to(observations).tolerating(fit.background.scales or Scales())
    return again, aligned(observations, simulation)


def _stored(start: Fit, alone: Fit, complete: Fit, left: ResidualStructure, blocks: Blocks) -> Fit:
    """Return the content of extended.toml: the complete fit, or the part that is surely better on another recording.

    Args:
        alone: the complete fit without a smooth model.
    """
    markers = is_marker(complete)
    has_model = left.model is not None and left.model.stored is not None
    largest = alone.settled() if has_model else complete
    fits = [start.to(start.observations.whole), largest]
    if largest.causes and largest.background.scales is not None:
        fits.insert(1, start.with_causes(largest.causes))
    best = stored(fits, markers)
    if left.model is not None and has_model:
        return complete if is_better_with(left.model, best, markers, blocks) else best
    return best


def _searched(begun: Fit, search: Search) -> Fit:
    """Run the search for causes from a fit, and refit with tolerances updated to its findings."""
    extended = begun
    for _ in range(DiagnosisSettings.rescaled):
        begun = _with_small_ones_tolerated(begun)
        extended = search.run(begun)
        before = extended.background.scales or Scales()
        # Possibly all causes are unnamed, and inflate the apparent tolerances.
        bare = extended.with_causes([])
        search.path = [bare.tolerating(before.no_larger), bare, *search.path[1:]]
        scales = tolerated(extended).scales
        moved = np.abs(np.log(scales) - np.log(before)).max()
        is_same = not _small_ones(extended) and moved < DiagnosisSettings.same_scale
        if search.ended_early or is_same:
            break
        begun = extended.tolerating(scales, _small_ones(extended))
    return extended


def _with_small_ones_tolerated(fit: Fit) -> Fit:
    """Refit with those periodic errors of drives as tolerances that are no larger than other drives' errors."""
    fit = with_small_ripples(fit)
    small = _small_ones(fit)
    return fit.tolerating(tolerated(fit).scales, small) if small else fit


def _small_ones(fit: Fit) -> list[Effect]:
    """Return the causes of a fit that are no larger than its tolerances."""
    return [cause for cause in fit.causes if fit.background.tolerates(cause)]


def _exceeds(some: FloatArray, others: FloatArray) -> float:
    """Return the probability that one of `some` is larger than one of `others`; ties count half."""
    ordered = np.sort(others)
    below = np.searchsorted(ordered, some, "left") + np.searchsorted(ordered, some, "right")
    return float(0.5 * below.mean() / len(ordered))


def _geometry(start: Fit) -> Fit:
    """Fit the best purely geometric model."""
    robot = start.simulation.robot
    present = {effect.key for effect in start.simulation.effects}
    wanted = [Effect.at(robot, "camera_pose"), Effect.at(robot, "tool_offset")]
    wanted += [Effect.at(robot, "link_geometry", joint) for joint in robot.joints]
    free = [effect for effect in wanted if effect.key not in present]
    effects = [*start.simulation.effects, *free]
    return fitted(start.observations, start.simulation.with_effects(effects), len(effects), start.noise)
