"""Describe in words that a mechanic understands: the findings, the remedies, and the next measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodyschema.diagnosis.assess.rivals import (
    Alternative,
    CauseAssessment,
    can_be_measured,
    expected_separation,
    whole_range,
    wide_motion,
)
from bodyschema.diagnosis.assess.unnamed_alternative import UnnamedAlternative
from bodyschema.diagnosis.diagnosis import Diagnosis
from bodyschema.diagnosis.report.presenters.presenter import FoundCause, Workshop
from bodyschema.diagnosis.report.presenters.registry import named, presenter_of, rival_named
from bodyschema.effects import Effect
from bodyschema.effects.unexplained import PLACE
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

from .numbers import identifiable_values
from .result import (
    OUTLIERS,
    Cause,
    DiagnosisFile,
    Errors,
    Gain,
    Interval,
    ResultSettings,
    Tolerances,
    Unexplained,
    Verdict,
)


class _Settings:
    """Settings of the text, which change words and no figure."""

    by_tolerances = 0.95  # tolerances that leave at most this share of the error are mentioned
    untold = 10.0  # an interval with a larger ratio of its ends is given by its upper end
    # Causes in a headline, and their characters beyond one cause, to fit two lines on a screen and four on a phone.
    named, longest = 2, 120
    pairs = 3  # pairs of causes with a motion that tells them apart
    worth_a_motion = 25.0  # smallest Δχ² between two causes at which a motion is advised


# Measurements that reveal an unnamed cause.
_WATCH = {
    "joint": "compare its reading with an angle that is measured otherwise",
    "body": "press on it, or record with a second marker on what carries it",
    "place": "calibrate the cameras again, where they stand to each other too",
}


def in_order(causes: Sequence[Cause]) -> list[Cause]:
    """Return causes in the order in which to act: the most important first, small ones later, mere corrections last."""
    return sorted(causes, key=lambda cause: (cause.is_small, cause.is_correction, -cause.weight_percent))


def corrections(count: int) -> str:
    """Return a name for some causes that are no more probable than not."""
    return f"{count} correction{'s' * (count > 1)} whose cause is not known"


def other_shares(diagnosis: DiagnosisFile) -> list[tuple[str, float]]:
    """Return the shares of the gain [%] of corrections without a cause, of drives and of links, with their names."""
    few = [cause.share_of_gain_percent for cause in diagnosis.causes if cause.is_correction]
    named_shares = [(corrections(len(few)), sum(few))] if few else []
    if (of := diagnosis.tolerances) is not None:
        shares = ("small errors of drives", of.drives_share_percent), ("small errors of links", of.links_share_percent)
        named_shares += [(name, share) for name, share in shares if share > 0.0]
    return named_shares


def finding(
    name: str,
    where: str | None,
    source: str | None,
    numbers: dict[str, float],
    seen_by: str = "camera",
    *,
    timed: bool = True,
    weighed: bool = True,
) -> str:
    """Return one cause as a clause: fault, place and size.

    Args:
        numbers: only the given shifts and rotations count.
        seen_by: the kind of measuring device, as in `DiagnosisFile`.
        timed, weighed: as in `FoundCause`.
    """
    return presenter_of(name).finding(FoundCause(where, source, numbers, seen_by, timed, weighed))


def remedies(diagnosis: DiagnosisFile, robot: RobotDescription, steps: FloatArray, torques: FloatArray) -> list[str]:
    """Return advice on each cause, the one that explains most first.

    Args:
        steps: encoder step of each joint (d,) [rad, m]; 0 if unknown.
        torques: the largest torque of gravity on each joint (d,) [N·m, N].
    """
    workshop = Workshop(robot, steps, torques, {cause.effect: cause for cause in diagnosis.causes})
    causes = in_order(diagnosis.causes)
    found = [replace(FoundCause.of(cause), weighed=diagnosis.weighed) for cause in causes]
    texts = [presenter_of(each.effect).remedy(workshop, what) for each, what in zip(causes, found, strict=True)]
    return [_with_confirmation(cause, remedy, diagnosis) for cause, remedy in zip(causes, texts, strict=True)]


def _with_confirmation(cause: Cause, remedy: str, diagnosis: DiagnosisFile) -> str:
    """Return the remedy, preceded by the checks to make before any change."""
    is_open = cause.probability < ResultSettings.sure
    open_ones = [rival for rival in cause.rivals if rival.by == "this_motion" and is_open]
    rivals = [rival_named(rival, diagnosis.seen_by) for rival in open_ones[:2]]
    if diagnosis.verdict == "unexplained" and cause.effect != OUTLIERS:
        rivals.append("a part of what remains unexplained")
    if not rivals:
        return remedy
    itself = named(cause.effect, cause.where, cause.source, diagnosis.seen_by)
    return f"If it is {itself} and not {' or '.join(rivals)}: {remedy[0].lower()}{remedy[1:]}"


def sentence(
    verdict: Verdict,
    causes: Sequence[Cause],
    rms: Errors,
    gain: Gain,
    tolerances: Tolerances | None = None,
    named_mm: float | None = None,
    tolerated_mm: float | None = None,
    seen_by: str = "camera",
    *,
    timed: bool = True,
    weighed: bool = True,
) -> str:
    """Return the verdict in one or two short sentences.

    Args:
        named_mm: RMS without the smooth model of unnamed causes [mm], if there is one.
        tolerated_mm: RMS with small errors everywhere and no cause [mm], if such errors are detected.
        seen_by: the kind of measuring device, as in `DiagnosisFile`.
        timed, weighed: as in `FoundCause`.
    """
    figures = f"{rms.aligned:.3g} → {rms.extended:.3g} mm on held-out data"
    nothing = not causes and verdict != "unexplained"
    if nothing and rms.extended < _Settings.by_tolerances * rms.aligned:
        everywhere = f"small errors everywhere{_alternative_to_tolerances(tolerances, seen_by)}"
        return f"No cause stands out: {everywhere} explain {_share(gain)} ({figures})"
    if nothing and tolerances is not None and not tolerances.in_extended:
        return f"No cause stands out; small errors everywhere are not known well enough to correct {rms.aligned:.3g} mm"
    if nothing:
        return f"The simulation is right to within the noise: nothing found in {rms.aligned:.3g} mm of error"
    if not causes:
        text = "What is measured differs from the simulation in a way that none of the known effects explains"
        text += _alternative_to_tolerances(tolerances, seen_by)
        if named_mm is None:
            return text
        if not _has_share(tolerances):
            return f"{text}; a smooth model of it explains {_share(gain)} ({figures})"
        figures += f", {named_mm:.3g} mm without the model"
        return f"{text}; small errors everywhere and a smooth model of the rest explain {_share(gain)} ({figures})"
    head = _head(causes, tolerances, seen_by, timed=timed, weighed=weighed)
    if gain.held_out_percent <= 0.0:
        return f"{head}: this explains the samples that were fitted and no others ({figures})"
    if named_mm is not None:
        figures += f", {named_mm:.3g} mm without the smooth model of the rest"
    elif tolerated_mm is not None and tolerated_mm < _Settings.by_tolerances * rms.aligned:
        figures += f", {tolerated_mm:.3g} mm with tolerances alone"
    return f"{head}. RMS error {figures}{_open_part(verdict, causes, seen_by)}"


def _head(causes: Sequence[Cause], tolerances: Tolerances | None, seen_by: str, *, timed: bool, weighed: bool) -> str:
    """Return the largest causes as a sentence without its full stop."""
    ordered = in_order(causes)
    everywhere = (
        [f"small errors everywhere{_alternative_to_tolerances(tolerances, seen_by)}"] if _has_share(tolerances) else []
    )
    first = [cause for cause in ordered if not (cause.is_correction or (everywhere and cause.is_small))]
    first = first[: _Settings.named]
    findings = [
        finding(c.effect, c.where, c.source, identifiable_values(c), seen_by, timed=timed, weighed=weighed)
        for c in first
    ]
    clauses = [clause + _alternative(cause, seen_by) for clause, cause in zip(findings, first, strict=True)]
    if len(", ".join(clauses)) > _Settings.longest:
        first, clauses = first[:1], clauses[:1]
    if everywhere and first and first[-1].effect == OUTLIERS:
        everywhere.append(clauses.pop())
    others = [cause.is_outvoted or cause.is_correction for cause in ordered if cause not in first]
    if more := others.count(False):
        everywhere.append(f"{more} {'smaller' if first else 'small'} cause{'s' * (more > 1)}")
    if more := others.count(True):
        everywhere.append(corrections(more))
    parts = [*clauses, *everywhere]
    head = f"{', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else parts[0]
    return head[0].upper() + head[1:]


def _has_share(tolerances: Tolerances | None) -> bool:
    """Return True if small errors everywhere have more than a small share of the gain."""
    return tolerances is not None and tolerances.share_percent >= ResultSettings.small_percent


def _alternative(cause: Cause, seen_by: str) -> str:
    """Return the most probable alternative of an uncertain cause, in parentheses."""
    if not cause.leaves_open:
        return ""
    return f" ({'more probably' if cause.is_outvoted else 'or'} {rival_named(cause.rivals[0], seen_by)})"


def _alternative_to_tolerances(tolerances: Tolerances | None, seen_by: str) -> str:
    """Return the most probable cause instead of large tolerances, in parentheses."""
    if tolerances is None or not tolerances.leaves_open:
        return ""
    rival = tolerances.rivals[0]
    return f" (or {rival_named(rival, seen_by)}, {100.0 * rival.probability:.0f} %)"


def _open_part(verdict: Verdict, causes: Sequence[Cause], seen_by: str) -> str:
    """Return the part of a verdict's sentence on what remains open."""
    if verdict == "unexplained":
        return ". Part of the error remains unexplained"
    unsure = [cause for cause in causes if cause.leaves_open]
    if verdict != "undecided" or not unsure:
        return ""
    names = [named(c.effect, c.where, c.source, seen_by) for c in unsure]
    return f". Not sure: {', '.join(names)}; other causes explain as much"


def _share(gain: Gain) -> str:
    explained = round(gain.held_out_percent)
    return f"{explained} % of the error" if explained > 0 else "less than 1 % of the error"


def tolerance_sentence(tolerances: Tolerances, seen_by: str) -> str:
    """Return one sentence on the manufacturing tolerances of an arm; upper bounds if they are not detected."""

    def formatted(size: Interval, unit: str, sign: str = "") -> str:
        low, high = size.ci95
        if high > _Settings.untold * low:
            return f"at most {sign}{high:.1g}{unit}"
        return f"about {sign}{size.value:.1g}{unit}"

    length, angle = formatted(tolerances.length_mm, " mm"), formatted(tolerances.angle_deg, "°")
    drives = formatted(tolerances.drive_deg, "°", "±")
    return (
        f"The arm is made to {length} and {angle}; its drives run true to {drives}.{_alternatives(tolerances, seen_by)}"
    )


def _alternatives(tolerances: Tolerances, seen_by: str) -> str:
    """Return a sentence on possible causes instead of large tolerances."""
    names = [f"{rival_named(rival, seen_by)} ({100.0 * rival.probability:.0f} %)" for rival in tolerances.rivals]
    if not names:
        return ""
    return f" Or the links are more exact than that, and there is {' or '.join(names)}."


def actions(diagnosis: DiagnosisFile, remedies: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the steps to take, in order, and the remedies of small causes.

    Args:
        remedies: remedies of each cause, as returned by `remedies`.
    """
    ordered = list(zip(in_order(diagnosis.causes), remedies, strict=True)) if remedies else []
    steps = [remedy for cause, remedy in ordered if not cause.is_small]
    small = [remedy for cause, remedy in ordered if cause.is_small and not cause.is_correction]
    if more := sum(cause.is_correction for cause, _ in ordered):
        small.append(f"Change nothing because of {corrections(more)}: extended.toml has what is sure of them.")
    of = diagnosis.tolerances
    if of is not None and of.in_extended and of.share_percent >= ResultSettings.small_percent:
        steps.append(
            f"Use extended.toml: small errors of links and drives have a share of {of.share_percent:.0f} % of the gain,"
            " and no single one is worth fixing."
        )
    return steps, small


def modelled(rest: Unexplained) -> str:
    """Return one or two sentences on the smooth model in extended.toml; empty if no structure is left."""
    sentences = []
    if rest.model_joints:
        over = "the marker's place" if rest.model_joints == PLACE else f"the readings of {', '.join(rest.model_joints)}"
        sentences.append(f"extended.toml has a smooth model of it over {over}, as good as the recording is dense.")
    elif rest.what:
        why = ": none that it can hold is right on samples that were not fitted. More samples may tell one"
        sentences.append(f"extended.toml has no model of it{'' if rest.not_in_model else why}.")
    if rest.not_in_model:
        sentences.append(
            f"What changes with time is in no such model: {'; '.join(rest.not_in_model)}. Another recording will "
            "differ by it again."
        )
    return " ".join(sentences)


def evidence(assessed: CauseAssessment, seen_by: str) -> str:
    text = (
        f"Without it the fit is worse by Δχ² = {assessed.gain:.0f} for {assessed.dof} number{'s' * (assessed.dof > 1)}"
    )
    if not assessed.rivals:
        return f"{text}; nothing else comes near."
    rival = assessed.rivals[0]
    return f"{text}; the nearest rival: {cause_name(rival.hypothesis, seen_by)} ({100 * rival.probability:.0f} %)."


def cause_name(cause: Effect | UnnamedAlternative, seen_by: str) -> str:
    return named(*cause.key, seen_by) if isinstance(cause, Effect) else cause.what


def advice(diagnosis: Diagnosis, causes: Sequence[Cause], seen_by: str) -> tuple[str, ...]:
    """Return sentences of advice: motions that would separate confounded causes, and steps against unnamed causes.

    Args:
        causes: those of the diagnosis, possibly followed by outliers.
        seen_by: the kind of measuring device, as in `DiagnosisFile`.
    """
    sentences: list[str] = []
    pairs: dict[str, list[str]] = {}
    for cause, assessment, found in zip(diagnosis.causes, diagnosis.assessments, causes, strict=False):
        for rival in () if found.is_correction else assessment.rivals:
            one, other = cause_name(cause, seen_by), cause_name(rival.hypothesis, seen_by)
            if not rival.is_same_anywhere:
                pairs.setdefault(_motion(diagnosis, rival), []).append(f"{one} from {other}")
            elif can_be_measured(cause, rival.hypothesis):
                sentences.append(f"No motion tells {one} from {other}: measure both.")
            elif not rival.is_equivalent:
                sentences.append(
                    f"No motion tells {one} from {other}, which can do more besides: "
                    "a longer recording of the same kind would show whether it does that."
                )
            elif isinstance(rival.hypothesis, Effect):
                sentences.append(f"No motion tells {one} from {other}: fix whichever is easier.")
            if isinstance(rival.hypothesis, UnnamedAlternative):
                sentences.append(f"Watch whether {other}: {_WATCH[rival.hypothesis.kind]}.")
    sentences = [f"To tell {_joined(names)}, {motion}." for motion, names in pairs.items()] + sentences
    if diagnosis.unexplained.rattle is not None:
        sentences.append(f"Fasten the marker: {diagnosis.unexplained.rattle.what}.")
    if what := diagnosis.unexplained.unnamed:
        joints = [diagnosis.extended.simulation.robot.joints[k] for k in diagnosis.unexplained.joints]
        where = f" Look at {', '.join(joints)} first." if joints else ""
        sentences.append(f"None of the known effects fits {'; '.join(what)}.{where}{_of_the_model(diagnosis)}")
    return tuple(dict.fromkeys(sentences))


def _of_the_model(diagnosis: Diagnosis) -> str:
    has_model = diagnosis.unexplained.model is not None and diagnosis.unexplained.model.stored is not None
    is_stored = has_model and diagnosis.stored is diagnosis.extended
    return " The extended simulation is right about it only where the recording has been." if is_stored else ""


def _joined(pairs: Sequence[str]) -> str:
    """Return the first of some pairs of causes, and the number of the others."""
    more = len(pairs) - _Settings.pairs
    return ", ".join(pairs[: _Settings.pairs]) + (f" and {more} more" if more > 0 else "")


def _motion(diagnosis: Diagnosis, rival: Alternative) -> str:
    """Return a clause on the joint that, moved through its whole range, best separates a cause from a rival."""
    robot, fit = diagnosis.extended.simulation.robot, diagnosis.search_fit
    separation = [expected_separation(fit, rival.fit_with_it, wide_motion(fit, [k])) for k in range(len(robot.joints))]
    best = int(np.argmax(separation))
    if separation[best] >= _Settings.worth_a_motion:
        low, high = whole_range(fit, best)
        unit, scale = ("mm", 1e3) if robot.chain.prismatic[best] else ("°", 180.0 / np.pi)
        span = f"{low * scale:.0f}{unit} to {high * scale:.0f}{unit}"
        return f"move joint {robot.joints[best]} through its whole range ({span}) in another recording"
    poses = "record poses over the whole range of all joints, with stops and at different speeds"
    if rival.separation_anywhere >= _Settings.worth_a_motion:
        return poses
    pairs = len(fit.observations) * _Settings.worth_a_motion / rival.separation_anywhere
    return f"{poses}: about {float(f'{pairs:.1g}'):,.0f} of them, since the effect is small beside the noise"
