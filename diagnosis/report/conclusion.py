"""Convert a diagnosis to the words and figures of `diagnosis.json`."""

from __future__ import annotations

import math
from itertools import combinations

import msgspec
import numpy as np

from bodyschema.diagnosis.assess.rivals import Alternative, CauseAssessment, RivalSettings, resembles_sag
from bodyschema.diagnosis.diagnosis import Diagnosis, DiagnosisSettings
from bodyschema.diagnosis.fit.background import BackgroundSettings
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.net_evidence import WorthSettings, evidence_gain
from bodyschema.diagnosis.search.drives import alias_sentences
from bodyschema.diagnosis.search.joint_selection import is_at_limit
from bodyschema.diagnosis.search.scan import Candidate
from bodyschema.effects import Effect, Identity
from bodyschema.interfaces.records import FloatArray
from kbmaps.robust import HALF_WIDTH_95

from .residuals import ResidualSettings
from .result import (
    OUTLIERS,
    Cause,
    DiagnosisFile,
    Errors,
    Gain,
    Indistinguishable,
    Interval,
    Pairs,
    Rejected,
    ResultSettings,
    Tolerances,
    Unexplained,
    Verdict,
)
from .text import advice, evidence, sentence

# Cycles over a joint's range by which two of its ripples have to differ. The waves that were found along five curves
# differed by 1.0 to 1.4.
_OF_A_CURVE = 2.0
_UNKNOWN_WEIGHT = "the spread of the arm's weight, which the URDF does not state"
_UNTESTED_WEIGHT = "sag, which was not tested: robot.toml says that the hand bore the weight"


def conclusion(diagnosis: Diagnosis) -> DiagnosisFile:
    percent, interval = diagnosis.gain()
    # A tracker or a scanner has no intrinsics in robot.toml.
    seen_by = "instrument" if diagnosis.aligned.simulation.robot.calibration is None else "camera"
    causes = _causes(diagnosis, seen_by)
    kept = diagnosis.markers
    figures = {name: 1e3 * float(np.sqrt(np.square(d[kept]).mean())) for name, d in diagnosis.held_out.items()}
    traces = np.trace(diagnosis.noise[kept], axis1=1, axis2=2)
    # Residuals of held-out rows contain all of the noise.
    rms = Errors(**figures, noise_floor=min(1e3 * float(np.sqrt(traces.mean())), figures["extended"]))
    tolerances = _tolerances(diagnosis)
    verdict = _verdict(diagnosis, causes, percent, tolerances)
    counted = diagnosis.gain_with_outliers() if diagnosis.outliers else (None, None)
    gain = Gain(percent, interval, with_outliers_percent=counted[0], with_outliers_ci95=counted[1])
    timed = diagnosis.aligned.observations.motion.t is not None
    weighed = diagnosis.aligned.simulation.gravity.known
    named_mm, tolerated_mm = (
        None if d is None else 1e3 * float(np.sqrt(np.square(d[kept]).mean()))
        for d in (diagnosis.without_model, diagnosis.with_tolerances_alone)
    )
    return DiagnosisFile(
        verdict=verdict,
        sentence=sentence(
            verdict, causes, rms, gain, tolerances, named_mm, tolerated_mm, seen_by, timed=timed, weighed=weighed
        ),
        pairs=Pairs(len(diagnosis.markers), len(diagnosis.markers), diagnosis.outliers),
        rms_mm=rms,
        mean_mm=_mean_mm(diagnosis),
        gain=gain,
        causes=causes,
        rejected=_rejected(diagnosis),
        unexplained=_unexplained(diagnosis),
        advice=advice(diagnosis, causes, seen_by),
        limitations=_limitations(diagnosis),
        tolerances=tolerances,
        seen_by=seen_by,
        weighed=weighed,
    )


def _tolerances(diagnosis: Diagnosis) -> Tolerances:
    estimate = diagnosis.estimated_tolerances
    # A drive has errors of one and two periods per turn, each with a sine and a cosine, whose mean square is one half.
    angle_rad, drive_rad = BackgroundSettings.angle_rad, math.sqrt(4 / 2) * BackgroundSettings.drive_rad
    units = np.array([1e3 * BackgroundSettings.length_m, np.degrees(angle_rad), np.degrees(drive_rad)])
    sizes, is_detected = units * np.asarray(estimate.scales)[:3], estimate.is_detected[:3]
    wide = np.exp(HALF_WIDTH_95 * estimate.log_sigma[:3])
    lowest = np.where(is_detected, sizes / wide, 0.0)
    highest = np.where(is_detected, sizes * wide, units * estimate.upper_limit[:3])
    ends = zip(sizes.tolist(), lowest.tolist(), highest.tolist(), strict=True)
    intervals = [Interval(size, (low, high)) for size, low, high in ends]
    shares = diagnosis.shares
    in_extended = diagnosis.stored is diagnosis.extended or diagnosis.stored.background.scales is not None
    links, drives = 100.0 * shares.links, 100.0 * shares.drives
    in_place = diagnosis.alternatives_to_tolerances
    probable = [(effect, share) for effect, share in in_place if share >= RivalSettings.probable]
    rivals = tuple(Indistinguishable(*effect.key, "this_motion", share) for effect, share in probable)
    return Tolerances(
        *intervals, links_share_percent=links, drives_share_percent=drives, in_extended=in_extended, rivals=rivals
    )


def _verdict(diagnosis: Diagnosis, causes: tuple[Cause, ...], gain_percent: float, tolerances: Tolerances) -> Verdict:
    # A search that ends at its limit has only described the error, and so have tolerances beyond a workshop's.
    if diagnosis.unexplained.is_present or diagnosis.ended_early or is_at_limit(diagnosis.extended.background.scales):
        return "unexplained"
    if not causes:
        return "undecided" if tolerances.leaves_open else "nothing_found"
    is_open = any(cause.leaves_open for cause in causes) or tolerances.leaves_open or gain_percent <= 0.0
    return "undecided" if is_open else "explained"


def _mean_mm(diagnosis: Diagnosis) -> Errors:
    kept = diagnosis.markers
    figures = {name: 1e3 * float(d[kept].mean()) for name, d in diagnosis.held_out.items()}
    # The mean length of a normal vector, to second order in the spread of its square.
    noise = diagnosis.noise[kept]
    traces = np.trace(noise, axis1=1, axis2=2)
    shape = noise / np.maximum(traces, 1e-300)[:, None, None]
    lengths = np.sqrt(traces) * (1.0 - np.square(shape).sum(axis=(1, 2)) / 4.0)
    return Errors(**figures, noise_floor=min(1e3 * float(lengths.mean()), figures["extended"]))


def _causes(diagnosis: Diagnosis, seen_by: str) -> tuple[Cause, ...]:
    fit, worse = diagnosis.extended, [max(diagnosis.worse_without[c.identity], 1.0) for c in diagnosis.causes]
    # Causes that only describe the error may not exist at all.
    sure, causes = ResultSettings.even if diagnosis.ended_early else 1.0, []
    parts = zip(fit.causes, diagnosis.assessments, diagnosis.shares.causes, worse, strict=True)
    for cause, assessment, share, squares in parts:
        causes.append(
            Cause(
                effect=cause.name,
                where=cause.where,
                source=cause.source,
                parameters=_parameters(diagnosis, cause, assessment),
                probability=sure * assessment.probability,
                share_of_gain_percent=100.0 * share,
                held_out_gain_percent=100.0 * (1.0 - squares**-0.5),
                indistinguishable_from=tuple(_named(r) for r in assessment.rivals if r.is_same_here),
                rivals=tuple(_named(r) for r in assessment.rivals),
                evidence=evidence(assessment, seen_by),
            )
        )
    simulation = diagnosis.aligned.simulation
    what = _UNKNOWN_WEIGHT if simulation.bears_weight else _UNTESTED_WEIGHT
    giving = {cause.where for cause in fit.causes if cause.kind.is_spring}
    merged = merged_ripples(fit)
    for k, (cause, assessment) in enumerate(zip(fit.causes, diagnosis.assessments, strict=True)):
        beside_spring = not simulation.gravity.known and cause.where in giving and resembles_sag(cause.kind)
        if beside_spring or assessment.is_like_sag:
            causes[k] = _or_unnamed(causes[k], what)
        if cause.identity in merged:
            causes[k] = _or_unnamed(causes[k], f"another error of {cause.where} that depends on its angle")
    if diagnosis.outliers_are_found:
        causes.append(_outliers(diagnosis))
    return tuple(causes)


def merged_ripples(fit: Fit) -> set[Identity]:
    """Return the ripples of a joint whose periods are so similar that together they may describe any curve."""
    found = set[Identity]()
    ripples = [cause for cause in fit.causes if cause.kind.search == "cycles"]
    for one, other in combinations(ripples, 2):
        if one.where == other.where:
            span = float(np.ptp(fit.observations.motion.q[:, fit.simulation.place(one).joint]))
            turns = span if one.prismatic else span / (2.0 * math.pi)
            if abs(float(one.values[-1] - other.values[-1])) * turns < _OF_A_CURVE:
                found |= {one.identity, other.identity}
    return found


def _or_unnamed(cause: Cause, what: str) -> Cause:
    """Return a cause that may be an unnamed one, or a part of it."""
    rival = Indistinguishable("unexplained", None, None, "this_motion", ResultSettings.even, what)
    probability = min(cause.probability, ResultSettings.even)
    return msgspec.structs.replace(cause, probability=probability, rivals=(rival, *cause.rivals))


def _named(rival: Alternative) -> Indistinguishable:
    by = "any_motion" if rival.is_same_anywhere else "this_motion"
    if isinstance(rival.hypothesis, Effect):
        return Indistinguishable(*rival.hypothesis.key, by, rival.probability)
    return Indistinguishable("unexplained", None, None, by, rival.probability, rival.hypothesis.what)


def _outliers(diagnosis: Diagnosis) -> Cause:
    n, found = len(diagnosis.markers), diagnosis.outliers
    share = found / n
    half = HALF_WIDTH_95 * float(np.sqrt(share * (1.0 - share) / n))
    return Cause(
        effect=OUTLIERS,
        where=None,
        source=None,
        parameters={"share": Interval(share, (max(share - half, 0.0), share + half))},
        probability=1.0,
        share_of_gain_percent=0.0,
        held_out_gain_percent=0.0,
        indistinguishable_from=(),
        rivals=(),
        evidence=f"{found} of {n} fixes are farther from all others than the noise can put them.",
    )


def _parameters(diagnosis: Diagnosis, cause: Effect, assessment: CauseAssessment) -> dict[str, Interval]:
    fit = diagnosis.extended
    places = fit.places(cause)
    covariance = fit.covariance[np.ix_(places, places)]
    halves = HALF_WIDTH_95 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    fitted = [*cause.amounts, *cause.shapes]
    numbers = {}
    for k in cause.described:
        parameter, value = cause.parameters[k], float(cause.values[k])
        if k in fitted:
            half = float(halves[fitted.index(k)])
            # A period, a time constant and a remaining share cannot be negative.
            low = max(value - half, 0.0) if k in cause.shapes else value - half
            numbers[parameter.name] = Interval(value, (low, value + half))
        else:
            numbers[parameter.name] = Interval(value, _moment_interval(cause, assessment.hypothesis))
    return numbers | _derived(cause, covariance)


def _moment_interval(cause: Effect, hypothesis: Candidate) -> tuple[float, float]:
    value = float(cause.values[-1])
    if hypothesis.interval is None:
        return (value, value)
    return (min(hypothesis.interval[0], value), max(hypothesis.interval[1], value))


def _derived(cause: Effect, covariance: FloatArray) -> dict[str, Interval]:
    """Return amplitude and phase of an effect with sine and cosine: value · sin(period · angle + phase)."""
    names = [parameter.name for parameter in cause.parameters]
    if names[0] not in ("sine_rad", "sine_m"):
        return {}
    unit = names[0].removeprefix("sine_")
    sine, cosine = cause.values[:2]
    amplitude = float(np.hypot(sine, cosine))
    radial = np.array([sine, cosine]) / max(amplitude, 1e-300)
    half = HALF_WIDTH_95 * float(np.sqrt(max(radial @ covariance[:2, :2] @ radial, 0.0)))
    across = np.array([-cosine, sine]) / max(amplitude, 1e-300)
    turn = HALF_WIDTH_95 * float(np.sqrt(max(across @ covariance[:2, :2] @ across, 0.0))) / max(amplitude, 1e-300)
    phase = float(np.arctan2(cosine, sine))
    return {
        f"amplitude_{unit}": Interval(amplitude, (max(amplitude - half, 0.0), amplitude + half)),
        "phase_rad": Interval(phase, (phase - turn, phase + turn)),
    }


def _rejected(diagnosis: Diagnosis) -> tuple[Rejected, ...]:
    tried = max(len(diagnosis.hypotheses.effects), 1)
    rows = []
    for candidate, more in diagnosis.rejected:
        chance = min(1.0, more.p_value * tried)
        why = _why_not(diagnosis, candidate, tried) if chance < ResidualSettings.significant else ""
        rows.append(Rejected(*candidate.effect.key, more.held_out_gain_percent, chance, why))
    return tuple(sorted(rows, key=lambda row: row.held_out_gain_percent, reverse=True))


def _why_not(diagnosis: Diagnosis, candidate: Candidate, tried: int) -> str:
    """Return the reason why a hypothesis with a small p-value is not a cause."""
    if diagnosis.unexplained.is_present:
        return "what has no name shows in it"
    if not candidate.effect.is_valid:
        return "it would be negative"
    if (
        evidence_gain(candidate.gain, candidate.dof) - float(np.log(tried * candidate.trials))
        < WorthSettings.named_nats
    ):
        return "too little for its numbers"
    if diagnosis.ended_early:
        return "not reached"
    return "no better with all refitted"


def _limitations(diagnosis: Diagnosis) -> tuple[str, ...]:
    sentences = list(diagnosis.hypotheses.limitations)
    sided = [cause for cause in diagnosis.causes if cause.kind.by_direction]
    unknown_side = diagnosis.extended.unknown_history(sided).mean()
    if unknown_side > DiagnosisSettings.max_doubtful:
        joints = ", ".join(str(cause.where) for cause in sided)
        sentences.append(
            f"At {100.0 * unknown_side:.0f} % of the samples it is unknown on which side of its backlash {joints} "
            "rests: few runs cross it. What seems to jump or to change with time there may be that. Record longer "
            "runs, and move the joint to and fro in each."
        )
    if diagnosis.leaves_out or len(diagnosis.stored.causes) < len(diagnosis.causes):
        sentences.append(_left_out(diagnosis.stored))
    sentences += alias_sentences(diagnosis.extended)
    if is_at_limit(diagnosis.extended.background.scales):
        sentences.append(
            "Small errors everywhere would have to be larger than any workshop makes them: there may be several causes "
            "behind them that this recording does not separate. Move one joint at a time in another recording."
        )
    if diagnosis.ended_early:
        sentences.append(
            "The causes found describe the error and do not explain it: there may be others in their place."
        )
    return tuple(sentences)


def _left_out(stored: Fit) -> str:
    """Return a sentence on the parts that extended.toml leaves out."""
    parts = ["the causes"] if stored.causes else []
    parts += ["small errors everywhere"] if stored.background.scales is not None else []
    held = " and ".join(parts) or "none of it but the parameters that robot.toml calls unknown"
    return (
        f"extended.toml holds {held}: with all that was found here it would not surely be better on another recording. "
        "Record poses over the whole range of all joints."
    )


def _unexplained(diagnosis: Diagnosis) -> Unexplained:
    unexplained, joints = diagnosis.unexplained, diagnosis.extended.simulation.robot.joints
    names = [joints[k] for k in unexplained.joints] + (["time"] if unexplained.with_time else [])
    rattle_mm = 0.0 if unexplained.rattle is None else 1e3 * unexplained.rattle.half_m
    if unexplained.model is None:
        rms = float(np.hypot(rattle_mm, 1e3 * unexplained.autocorrelated_rms_m))
        return Unexplained(rms, tuple(names), unexplained.p_value, unexplained.what, (), unexplained.not_storable)
    rms = float(np.hypot(rattle_mm, 1e3 * np.sqrt(np.square(diagnosis.modelled).sum(axis=1).mean())))
    model = unexplained.model.stored if diagnosis.stored is diagnosis.extended else None
    stored = () if model is None else tuple(dict.fromkeys(model.joints))
    return Unexplained(rms, tuple(names), unexplained.p_value, unexplained.what, stored, unexplained.not_storable)
