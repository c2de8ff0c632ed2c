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
    change_by_path,
    explain,
    naming_cost,
    useful,
    without_cause,
)
from bodyschema.diagnosis.assess.residual_structure import ResidualStructure, residual_structure
from bodyschema.diagnosis.assess.rivals import CauseAssessment, assessments
from bodyschema.diagnosis.assess.shares import Shares, shares
from bodyschema.diagnosis.assess.stored import is_better_with, stored
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.background import Scales
from bodyschema.diagnosis.fit.fit import Fit, fitted
from bodyschema.diagnosis.fit.instrument import instrument_factor, reshaped
from bodyschema.diagnosis.fit.net_evidence import WorthSettings
from bodyschema.diagnosis.fit.noise import correlation, is_autocorrelated
from bodyschema.diagnosis.fit.observations import IntArray, Observations
from bodyschema.diagnosis.search.drives import with_small_ripples
from bodyschema.diagnosis.search.held_out import (
    Blocks,
    HeldOutGain,
    gain_percent,
    held_out_errors,
    held_out_gains,
    is_marker,
)
from bodyschema.diagnosis.search.hypotheses import Hypotheses
from bodyschema.diagnosis.search.joint_selection import (
    ToleranceEstimate,
    alternatives_to_tolerances,
    estimated_tolerances,
    together,
)
from bodyschema.diagnosis.search.scan import Candidate, Scan, refit_moment
from bodyschema.diagnosis.search.search import Search, are_only_descriptive
from bodyschema.diagnosis.unnamed.family_fits import UnnamedFamilies
from bodyschema.diagnosis.unnamed.rattle import LooseMarker, likelihood, rattle, rattle_with_refit
from bodyschema.effects import Effect, Identity, Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording

from .progress import RIVALS, SEARCH, SETS, UNNAMED, Stages

ReportProgress = Callable[[str], None]


class DiagnosisSettings:
    """Settings of the diagnosis.

    Sensitivity, each at 0.3 and 3 times over seven recordings with hidden errors: `same_scale` and `rescaled`, with
    which tolerances are fitted again, change one and three reports; `little` changes a word. The others change nothing
    there; `max_dof_share`, `same_noise`, `most_rows` and `run` were tried on three of them alone, none a long one.
    """

    min_outliers = 3  # fewer outliers than this are not a finding
    min_outlier_evidence = 15.0  # smallest evidence gain for reporting outliers [nats]
    mostly = 0.8  # outliers count as motion-related if they occur on faster rows at least this often
    # Farther off than this, in units of the change by the path between two readings, the path cannot be the reason.
    max_model_error_ratio = 4.0
    # Smallest change of the tolerance scales (in logarithms) that triggers a refit, and the maximum of refits.
    same_scale, rescaled = 0.25, 3
    rattled = 2  # fits with the play of a loose marker; the first tells the noise beside it
    little = 0.9  # squares reduced by less than to this share are reduced a little
    max_dof_share = 0.9  # the fit absorbs at most this share of the noise
    same_noise = 0.1  # smallest change of the instrument's noise (in logarithms) that triggers a refit
    # In more than twice as many rows, causes are sought in runs of neighbouring rows, and fitted to all of them.
    max_rows, run = 1000, 50
    # Rows before which the state is unknown are left out while most rows remain: a false jump may stand in for them.
    max_doubtful = 0.5


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The errors found in a simulation, with everything that a report shows about them."""

    hypotheses: Hypotheses  # the effects that were tested, and the reasons why others were not
    nominal: Fit  # the unchanged simulation
    aligned: Fit  # fit of the parameters that robot.toml does not know
    geometry: Fit  # fit with all lengths, axes, joint offsets, the tool and the camera's pose free
    extended: Fit  # fit with the causes, the tolerances, and the smooth model of the unnamed causes
    without_smooth_model: Fit  # the same without the smooth model
    stored: Fit  # the part of it that is surely better on another recording, which is written to extended.toml
    estimated_tolerances: ToleranceEstimate  # sizes of the tolerances
    assessments: tuple[CauseAssessment, ...]  # assessment of each cause against its rivals
    unexplained: ResidualStructure  # residual structure that no effect fits
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
        """Held-out distances (n,) [m] with causes and tolerances but no smooth model, or None."""
        if self.unexplained.model is None or self.unexplained.model.stored is None or self.leaves_out:
            return None
        return np.linalg.norm(held_out_errors(self.without_smooth_model, self.blocks), axis=1)

    @cached_property
    def modelled(self) -> FloatArray:
        """Change of the predictions (n, 3) [m] by the model of unnamed causes, with everything else refitted."""
        if self.unexplained.model is None:
            return np.zeros_like(self.extended.predicted)
        return self.extended.predicted + self.unexplained.model.unstored - self.without_smooth_model.predicted

    def _extended_errors(self, fit: Fit) -> FloatArray:
        """Return measured minus predicted (n, 3) [m] on rows held out from causes and smooth model."""
        if self.unexplained.model is None:
            return held_out_errors(fit, self.blocks)
        return fit.observations.x - fit.predicted + self.unexplained.model.in_sample_change

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
        return int(self._outlier_rows.sum())

    @property
    def _outlier_rows(self) -> np.ndarray:
        return ~self.markers & self.extended.observations.trusted & ~self.extended.unknown_history()

    @property
    def outliers_are_found(self) -> bool:
        """Return True if outliers are numerous and large enough to be a finding."""
        net_evidence = self.extended.noise.log_likelihood - self.extended.without_outliers
        named = (
            self.outliers >= DiagnosisSettings.min_outliers and net_evidence > DiagnosisSettings.min_outlier_evidence
        )
        return named and not self._outliers_where_fast() and not self._outliers_within_model_error()

    def _outliers_within_model_error(self) -> bool:
        """Return True if the outliers are no farther off than roughly known influences can explain.

        These are the path between two readings, which was not observed, and unnamed causes.
        """
        fit = self.extended
        changes = [change_by_path(fit)]
        if self.unexplained.model is not None:
            changes.append(self.unexplained.model.explained)
        squares = np.square(fit.observations.whitened(np.stack(changes, axis=2))).sum(axis=1).mean(axis=0)
        off = np.square(fit.residuals[self._outlier_rows]).sum(axis=1)
        return bool(np.median(off) < DiagnosisSettings.max_model_error_ratio**2 * squares.sum())

    def _outliers_where_fast(self) -> bool:
        """Return True if most outliers are at the fastest rows; the motion is then poorly modelled."""
        motion = self.extended.observations.motion
        steps = np.linalg.norm(motion.moves, axis=1)
        duration = np.ones(len(motion)) if motion.t is None else np.append(np.inf, np.diff(motion.t))
        speed = steps / np.maximum(duration, 1e-9)
        on, off = self.markers, self._outlier_rows
        return max(_probability_larger(v[off], v[on]) for v in (steps, speed)) > DiagnosisSettings.mostly

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
        if self.part is not None and self.unexplained.model is None:
            fit, blocks = self.search_fit, Blocks.cut(len(self.part))
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
        unnamed = None if self.unexplained.model is None else self.unexplained.model.explained
        return shares(self.aligned, self.extended, self.markers, unnamed)

    @cached_property
    def noise(self) -> FloatArray:
        """Noise covariances (n, 3, 3) [m²], from the residuals of the complete model.

        If neighbouring rows share nearly all of their residuals, only the rest is noise: half the square of their
        differences.
        """
        fit, kept = self.extended, self.markers
        if self.unexplained.model is not None:
            # Large tolerances moved into the simulation are right to first order only.
            fit = self.unexplained.model.fit
        unstored = 0.0 if self.unexplained.model is None else self.unexplained.model.unstored
        unexplained = fit.observations.x - fit.predicted - unstored
        motion = fit.observations.motion
        shared = correlation(np.where(kept[:, None], unexplained, 0.0), motion.begins)
        shared = shared if self.unexplained.rattle is None and is_autocorrelated(shared, motion.begins) else 0.0
        unexplained = unexplained[kept]
        roots = np.linalg.inv(fit.observations.whitening)
        stated = roots @ np.swapaxes(roots, 1, 2)
        # Scale the stated noise to the size of the residuals, corrected for the degrees of freedom of the fit.
        effective_dof = min(
            fit.background.effective_dof(fit.noise.sigma) / max(unexplained.size, 1), DiagnosisSettings.max_dof_share
        )
        size = (
            np.square(unexplained).sum()
            / np.trace(stated[kept], axis1=1, axis2=2).sum()
            / (1.0 - effective_dof)
            * (1.0 - shared)
        )
        # The play of a loose marker is not noise.
        return float(size) * fit.observations.noise_covariances

    @cached_property
    def with_tolerances_alone(self) -> FloatArray | None:
        """Held-out distances (n,) [m] with tolerances and no cause; None if no tolerance is detected."""
        if not self.causes or not self.estimated_tolerances.is_detected.any():
            return None
        return np.linalg.norm(held_out_errors(self.extended.with_causes([]), self.blocks), axis=1)

    @cached_property
    def search_fit(self) -> Fit:
        """The complete fit over the rows used in the search for causes."""
        return self.extended if self.part is None else self.extended.over(self.part)

    @cached_property
    def alternatives_to_tolerances(self) -> list[tuple[Effect, float]]:
        """Possible causes instead of tolerances of several times a workshop's, with probabilities."""
        return (
            [] if self.unexplained.is_present else alternatives_to_tolerances(self.search_fit, self.hypotheses.effects)
        )

    @cached_property
    def rejected(self) -> list[tuple[Candidate, HeldOutGain]]:
        """Rejected hypotheses, each with its best fit beside the causes."""
        present = {cause.key for cause in self.causes}
        fit = self.search_fit
        blocks = self.blocks if self.part is None else Blocks.cut(len(self.part))
        candidates = Scan(fit).candidates(h for h in self.hypotheses.effects if h.key not in present)
        return list(zip(candidates, held_out_gains(fit, candidates, blocks), strict=True))


def diagnose(
    recording: Recording,
    simulation: Simulation,
    *,
    only: Collection[str] = (),
    without: Collection[str] = (),
    seed: int = 0,
    blocks: Blocks | None = None,
    tell: ReportProgress = lambda _: None,
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
    progress = Stages(tell)
    progress.begin(SETS)
    progress(f"{len(hypotheses.effects)} hypotheses")
    blocks = blocks or Blocks.cut(len(recording))
    rows = _searched_rows(observations.motion.begins)
    if len(rows) == len(observations):
        found = _search(observations, simulation, hypotheses.effects, blocks, seed, progress)
    else:
        part = _search(observations.some(rows), simulation, hypotheses.effects, Blocks.cut(len(rows)), seed, progress)
        progress(f"the same in all {len(observations)} rows")
        found = part.over(observations, simulation)
    start, explanation, search = found.start, found.explanation, found.search
    if found.loose is not None:
        # If the side depends on the pose, a model of this dependence predicts better.
        start = aligned(start.observations.without_history, simulation)
    unexplained = found.unexplained(blocks)
    fit = (explanation.fit if unexplained.model is None else unexplained.model.fit).with_tolerances_applied()
    tolerances = estimated_tolerances(fit)
    if unexplained.model is None and not tolerances.is_detected.any():
        fit = fit.without_tolerances()
    return Diagnosis(
        hypotheses=hypotheses,
        nominal=fitted(start.observations, simulation, len(simulation.effects)),
        aligned=start,
        geometry=_geometry(start),
        extended=fit,
        without_smooth_model=explanation.fit,
        stored=fit if fit.is_exact else _stored(start, explanation.fit, fit, unexplained, blocks),
        estimated_tolerances=tolerances,
        assessments=tuple(found.assessments),
        unexplained=unexplained,
        blocks=blocks,
        seed=seed,
        part=None if found.part is None else found.part.start.observations,
        ended_early=search.ended_early or are_only_descriptive(fit.causes),
    )


@dataclass(frozen=True, eq=False)
class _SearchResult:
    """Result of a search in some observations."""

    start: Fit  # fit of the parameters that robot.toml does not know
    search: Search
    unnamed: UnnamedFamilies
    explanation: Explanation
    assessments: Sequence[CauseAssessment]  # assessment of each cause against its rivals
    loose: LooseMarker | None  # play of the marker; None for one that is fixed
    is_reshaped: bool  # True if the noise has another shape than stated
    part: _SearchResult | None = None  # result for a part of the observations; None if all were searched

    def unexplained(self, blocks: Blocks) -> ResidualStructure:
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
        if before.ignored is not None:
            observations = observations.ignoring(_left_out(fit))
        if loose is not None:
            loose = rattle(fit) or loose
            observations = observations.with_loose_marker(loose.ratio, loose.directions_at(fit))
        fit, assessed = fit.to(observations), list(self.assessments)
        for k in range(len(assessed)):
            moment = (
                _refit_moment_between(fit, fit.causes[k], before.motion.clock) if fit.causes[k].kind.begins else None
            )
            if moment is not None:
                causes = [*fit.causes]
                causes[k] = moment.effect
                fit, assessed[k] = fit.with_causes(causes), replace(assessed[k], hypothesis=moment)
        again = replace(
            self, explanation=replace(self.explanation, fit=fit), assessments=assessed, loose=loose, part=self
        )
        return again.of(observations, simulation)

    def of(self, observations: Observations, simulation: Simulation) -> _SearchResult:
        """Return the same causes, fitted to other observations of the same motion."""
        start = aligned(observations, simulation)
        unnamed, fit = UnnamedFamilies(start), self.explanation.fit.to(observations)
        chosen = unnamed.again(self.explanation.unnamed_causes)
        discrepancy_fit = unnamed.discrepancy_fit(fit, chosen) if chosen else None
        return replace(
            self,
            start=start,
            unnamed=unnamed,
            explanation=replace(self.explanation, fit=fit, discrepancy_fit=discrepancy_fit),
        )


def _searched_rows(begins: NDArray[np.bool_]) -> IntArray:
    """Return the rows in which to search for causes: all, or equal runs that are spread over a long recording.

    Each run is the one of its stretch with the fewest breaks: after a break, the side of a joint's backlash is
    unknown.

    Args:
        begins: (n,), True in the first row after each break.
    """
    rows = len(begins)
    if rows <= 2 * DiagnosisSettings.max_rows:
        return np.arange(rows)
    breaks = np.convolve(begins[1:], np.ones(DiagnosisSettings.run - 1), "valid")
    runs = DiagnosisSettings.max_rows // DiagnosisSettings.run
    firsts = np.linspace(0, rows - DiagnosisSettings.run, runs).astype(np.intp)
    for k, (first, after) in enumerate(pairwise(firsts.tolist())):
        firsts[k] += np.argmin(breaks[first : after - DiagnosisSettings.run + 1])
    return (firsts[:, None] + np.arange(DiagnosisSettings.run)).ravel()


def _refit_moment_between(fit: Fit, cause: Effect, searched: FloatArray) -> Candidate | None:
    """Return a cause that begins at a moment with its best moment, which was searched for only at some times (m,)."""
    clock, after = fit.observations.motion.clock, int(np.searchsorted(searched, cause.values[-1]))
    between = (clock > searched[max(after - 1, 0)]) & (clock < searched[min(after, len(searched) - 1)])
    return refit_moment(fit, cause, between)


def _left_out(fit: Fit) -> NDArray[np.bool_]:
    """Return the rows (n,) to leave out because their history is not known well enough.

    If they are too many, return only the first ones; the arm is then assumed to go straight from each run to the next.
    """
    rows = fit.unknown_history()
    return rows if rows.mean() <= DiagnosisSettings.max_doubtful else fit.unknown_history_at_first


def _search(
    observations: Observations,
    simulation: Simulation,
    hypotheses: Sequence[Effect],
    blocks: Blocks,
    seed: int,
    progress: Stages,
) -> _SearchResult:
    """Search for the causes in some observations, and test for unnamed causes."""
    start = aligned(observations, simulation)
    search = Search(hypotheses, progress)
    initial_fit = start if start.is_exact else together(start, hypotheses, progress)
    progress.begin(SEARCH, SETS)
    # The most probable set gives the noise, and the rows to leave out, before the long search.
    initial_fit, start = _refitted(initial_fit, start, simulation)
    unnamed = UnnamedFamilies(start)
    extended = search.run(initial_fit) if start.is_exact else _searched(initial_fit, search)
    other_shape = None if start.is_exact else reshaped(extended)
    if other_shape is not None and (
        rattle(extended) or explain(extended, search.path, unnamed, search, progress).unnamed_causes
    ):
        # The remainder is not only noise.
        other_shape = None
    again, start = (extended, start) if search.ended_early else _refitted(extended, start, simulation, other_shape)
    if again is not extended:
        unnamed = UnnamedFamilies(start)
        extended = _searched(again, search)
    progress.begin(UNNAMED, SEARCH)
    explanation = explain(extended, search.path, unnamed, search, progress)
    # A loose marker does not slip, and changes of its side may have been named jumps and bumps.
    steady = [cause for cause in extended.causes if cause.kind.stage != "tool" and not cause.kind.begins]
    # Likelihoods can only be compared over the same rows.
    bare = initial_fit.with_causes([]).to(start.observations)
    fits = [start, bare, *([extended.with_causes(steady)] if steady else [])]
    loose = None if start.is_exact else _loose(explanation, fits, search)
    for _ in range(DiagnosisSettings.rattled if loose is not None else 0):
        assert loose is not None
        progress(loose.what)
        # Start again: causes may have been named because of the play, and the noise is smaller without it.
        # A loose marker has no offset of its own, and does not slip.
        fixed = [effect for effect in hypotheses if effect.kind.stage != "tool"]
        search = Search(fixed, progress)
        start = aligned(loose.removed_from(start.observations), simulation)
        unnamed = UnnamedFamilies(start)
        extended = search.run(start) if start.is_exact else _searched(together(start, fixed, progress), search)
        explanation = explain(extended, search.path, unnamed, search, progress)
        loose = rattle(extended) or loose
    explanation = useful(explanation, search, blocks, progress)
    progress.begin(RIVALS, UNNAMED)
    assessed = assessments(explanation.named_fit, search, blocks, seed, None if explanation.unnamed_causes else unnamed)
    while explanation.unnamed_causes and any(assessment.probability < 0.5 for assessment in assessed):
        weakest = int(np.argmin([assessment.probability for assessment in assessed]))
        fewer = without_cause(explanation, explanation.fit.causes[weakest], unnamed, search)
        if not fewer.unnamed_causes:
            break
        explanation = fewer
        assessed = assessments(explanation.named_fit, search, blocks, seed)
    found = _SearchResult(start, search, unnamed, explanation, assessed, loose, other_shape is not None)
    if loose is None:
        return found
    # No simulation predicts the side on which the marker lies.
    without_history = start.observations.without_marker_play(np.zeros_like(start.observations.x)).ignoring(
        _left_out(explanation.fit)
    )
    return found.of(without_history.with_loose_marker(loose.ratio, loose.directions), simulation)


def _loose(explanation: Explanation, fits: Sequence[Fit], search: Search) -> LooseMarker | None:
    """Return the play of a loose marker if its two sides beside one of the fits are more probable than everything else.

    A joint's error can move the marker along one line as well, but then the joints or the path predict its position.
    """
    named_fit, found = (
        explanation.named_fit,
        [(rattle_with_refit(fit), naming_cost(fit.causes, search)) for fit in fits],
    )
    other = explanation.net_evidence - explanation.independence * named_fit.log_likelihood + likelihood(named_fit)
    net_evidences = [(play.likelihood - names - other, play) for play, names in found if play is not None]
    net_evidence, play = max(net_evidences, key=lambda one: one[0], default=(-np.inf, None))
    return play if net_evidence > WorthSettings.named_nats else None


def _refitted(fit: Fit, start: Fit, simulation: Simulation, shape: Observations | None = None) -> tuple[Fit, Fit]:
    """Refit with the estimated noise and without the rows that the causes leave out; return the fit if nothing changes.

    Args:
        start: fit of the parameters unknown to robot.toml, returned with the same observations.
        shape: the observations with another shape of the noise; None if it stays.
    """
    observations = fit.observations
    factor, left_out = instrument_factor(fit), _left_out(fit)
    before = np.zeros_like(left_out) if observations.ignored is None else observations.ignored
    # Other amounts of the same causes change few rows.
    other_rows = (left_out ^ before).sum() > (left_out & before).sum()
    other_noise = abs(np.log(factor / observations.stated_factor)) > DiagnosisSettings.same_noise
    if fit.is_exact or not (other_rows or other_noise or shape is not None):
        return fit, start
    observations = (shape or observations).with_factor(factor).ignoring(left_out)
    again = fit.to(observations).with_tolerances(fit.background.scales or Scales())
    return again, aligned(observations, simulation)


def _stored(
    start: Fit, without_smooth_model: Fit, complete: Fit, unexplained: ResidualStructure, blocks: Blocks
) -> Fit:
    """Return the content of extended.toml: the complete fit, or the part that is surely better on another recording.

    Args:
        without_smooth_model: the complete fit without a smooth model.
    """
    markers = is_marker(complete)
    has_model = unexplained.model is not None and unexplained.model.stored is not None
    largest = without_smooth_model.with_tolerances_applied() if has_model else complete
    fits = [start.to(start.observations.without_history), largest]
    if largest.causes and largest.background.scales is not None:
        fits.insert(1, start.with_causes(largest.causes))
    best = stored(fits, markers)
    if unexplained.model is not None and has_model:
        return complete if is_better_with(unexplained.model, best, markers, blocks) else best
    return best


def _searched(initial_fit: Fit, search: Search) -> Fit:
    """Run the search for causes from a fit, and refit with tolerances updated to its findings."""
    extended = initial_fit
    for _ in range(DiagnosisSettings.rescaled):
        initial_fit = _with_small_drive_errors(initial_fit)
        extended = search.run(initial_fit)
        before = extended.background.scales or Scales()
        # Possibly all causes are unnamed, and inflate the apparent tolerances.
        bare = extended.with_causes([])
        search.path = [bare.with_tolerances(before.limited_to_workshop), bare, *search.path[1:]]
        scales = estimated_tolerances(extended).scales
        moved = np.abs(np.log(scales) - np.log(before)).max()
        is_same = not _small_drive_errors(extended) and moved < DiagnosisSettings.same_scale
        if search.ended_early or is_same:
            break
        initial_fit = extended.with_tolerances(scales, _small_drive_errors(extended))
    return extended


def _with_small_drive_errors(fit: Fit) -> Fit:
    """Refit with those periodic errors of drives as tolerances that are no larger than other drives' errors."""
    fit = with_small_ripples(fit)
    small = _small_drive_errors(fit)
    return fit.with_tolerances(estimated_tolerances(fit).scales, small) if small else fit


def _small_drive_errors(fit: Fit) -> list[Effect]:
    """Return the causes of a fit that are no larger than its tolerances."""
    return [cause for cause in fit.causes if fit.background.is_within_tolerance(cause)]


def _probability_larger(some: FloatArray, others: FloatArray) -> float:
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
