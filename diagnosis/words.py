"""Describe causes in words that a mechanic understands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyschema.effects import EFFECT_TYPES
from bodyschema.effects.unexplained import PLACE

from .numbers import told_values
from .result import Alike, Cause, Errors, Gain, Interval, Tolerances, Unexplained, Verdict
from .rivals import Standing

_DEG = 180.0 / np.pi
# A scale error below this reverses the joint's direction.
_BACKWARDS = -1.0
# Tolerances that leave at most this share of the error are mentioned.
_BY_TOLERANCES = 0.95
# An interval with a larger ratio of its ends is given by its upper end.
_UNTOLD = 10.0
# A headline names this many causes and counts the others, to fit two lines.
_TOLD = 2
# A less probable cause leaves the verdict open.
SURE = 0.9


def finding(
    name: str,
    where: str | None,
    source: str | None,
    numbers: dict[str, float],
    seen_by: str = "camera",
    *,
    timed: bool = True,
) -> str:
    """Return one cause as a clause: what is wrong, where, by how much.

    Args:
        numbers: only the shifts and turns given count.
        seen_by: the kind of measuring device, as in `DiagnosisFile`.
    """
    at = f"joint {where}"

    def size(*names: str) -> float:
        return float(np.linalg.norm([numbers[n] for n in names if n in numbers]))

    def turned(base: str) -> str:
        if f"{base}_rad" in numbers:
            return f"{numbers[f'{base}_rad'] * _DEG:+.3g}°"
        return f"{numbers[f'{base}_m'] * 1e3:+.3g} mm"

    shift = f"{1e3 * size('x_m', 'y_m', 'z_m'):.3g} mm"
    turn = f"{size('rx_rad', 'ry_rad', 'rz_rad') * _DEG:.2g}°"
    shifts, turns = ([axis for axis in "xyz" if form.format(axis) in numbers] for form in ("{}_m", "r{}_rad"))
    moved = " and ".join(said for said, axes in ((shift, shifts), (turn, turns)) if axes)
    when = f" at {'t =' if timed else 'row'} {numbers['t0']:.1f}" if "t0" in numbers else ""
    match name:
        case "joint_offset":
            return f"the zero of {at} is off by {turned('offset')}"
        case "joint_scale":
            if numbers["scale_error"] < _BACKWARDS:
                return f"{at} counts the other way than its encoder says"
            more = "more" if numbers["scale_error"] > 0.0 else "less"
            return f"{at} turns {100 * abs(numbers['scale_error']):.3g} % {more} than its encoder says"
        case "joint_eccentricity":
            return f"the encoder of {at} sits off its axis: ±{numbers['amplitude_rad'] * _DEG:.2g}° once a turn"
        case "joint_ripple":
            amplitude = (
                f"{numbers['amplitude_rad'] * _DEG:.2g}°"
                if "amplitude_rad" in numbers
                else (f"{1e3 * numbers['amplitude_m']:.2g} mm")
            )
            often = (
                f"{numbers['cycles_per_turn']:.3g} times a turn"
                if "cycles_per_turn" in numbers
                else f"{numbers['cycles_per_m']:.3g} times a metre"
            )
            return f"{at} has a ripple of ±{amplitude}, {often}"
        case "joint_coupling":
            return f"{at} moves by {100 * numbers['ratio']:+.3g} % of joint {source}'s angle"
        case "encoder_jump":
            return f"the zero of {at} jumped by {turned('jump')}{when}"
        case "backlash":
            return f"{at} has {turned('width').lstrip('+')} of play"
        case "settling":
            return f"{at} was read before it came to rest: {100 * numbers['fraction']:.2g} % of each move was missing"
        case "hysteresis":
            lag, length = turned("lag").lstrip("+"), turned("length").lstrip("+")
            return f"{at} lags by {lag} behind its reading, against the way it went, and turns round over {length}"
        case "gravity_backlash":
            return f"{at} has {turned('width').lstrip('+')} of play and hangs on the flank to which the weight pulls it"
        case "payload":
            return f"the hand carries {numbers['mass_kg']:.2g} kg that the URDF does not have"
        case "joint_compliance":
            if "compliance_rad_per_Nm" in numbers:
                return f"{at} gives by {numbers['compliance_rad_per_Nm'] * _DEG:.2g}°/N·m under the arm's weight"
            return f"{at} gives by {1e3 * numbers['compliance_m_per_N']:.2g} mm/N under the arm's weight"
        case "link_geometry":
            parts = ((shift, "in", shifts), (turn, "about", turns))
            said = [f"{amount}{_axes(how, axes)}" for amount, how, axes in parts if axes]
            return f"the link before {at} is off by {' and '.join(said)}"
        case "tool_offset":
            return f"the marker sits {shift} beside its place on the hand"
        case "tool_slip":
            return f"the marker slipped by {shift}{when}"
        case "camera_pose":
            return f"the {seen_by} stands {moved} off"
        case "camera_moved":
            return f"the {seen_by} {'was bumped' if seen_by == 'camera' else 'moved'} by {moved}{when}"
        case "camera_scale":
            return f"all that is measured is {100 * numbers['scale_error']:+.3g} % too large: the baseline is wrong"
        case "camera_focal":
            return f"the focal length is {100 * numbers['focal_error']:+.3g} % off: depth is scaled"
        case "lens_distortion":
            return f"the lenses still distort: k1 = {numbers['k1']:+.3g}"
        case "camera_latency":
            return f"images are stamped {1e3 * numbers['latency_s']:.3g} ms late"
        case "thermal_drift":
            return f"what is measured drifts by {shift} with a time constant of {numbers['time_constant_s']:.0f} s"
        case "outliers":
            return f"{100 * numbers['share']:.2g} % of the fixes are not the marker"
        case _:
            return EFFECT_TYPES[name].finding(at, numbers)


def _axes(how: str, axes: Sequence[str]) -> str:
    """Return along or about which axes of its frame a link is off; empty for all three."""
    return "" if len(axes) == len("xyz") else f" {how} {' and '.join(axes)}"


def sentence(
    verdict: Verdict,
    causes: Sequence[Cause],
    rms: Errors,
    gain: Gain,
    named_mm: float | None = None,
    tolerated_mm: float | None = None,
    seen_by: str = "camera",
    *,
    timed: bool = True,
) -> str:
    """Return the verdict in one or two short sentences.

    Args:
        named_mm: RMS with the causes alone [mm], where there is also a smooth model of unnamed causes.
        tolerated_mm: RMS with small errors everywhere and no cause [mm], where such errors show.
        seen_by: the kind of measuring device, as in `DiagnosisFile`.
    """
    figures = f"{rms.aligned:.3g} → {rms.extended:.3g} mm on held-out data"
    if verdict == "nothing_found" and rms.extended < _BY_TOLERANCES * rms.aligned:
        return f"No cause stands out: small errors everywhere explain {_share(gain)} ({figures})"
    if verdict == "nothing_found":
        return f"The simulation is right to within the noise: nothing found in {rms.aligned:.3g} mm of error"
    if not causes:
        told = "What is measured differs from the simulation in a way that none of the known effects explains"
        return told if named_mm is None else f"{told}; a smooth model of it explains {_share(gain)} ({figures})"
    largest = sorted(causes, key=lambda cause: -cause.share_of_gain_percent)
    told = [finding(c.effect, c.where, c.source, told_values(c), seen_by, timed=timed) for c in largest[:_TOLD]]
    head = told[0][0].upper() + told[0][1:]
    if more := len(largest) - len(told):
        head += f"; {', '.join(told[1:])}; {more} smaller cause{'s' * (more > 1)}"
    elif len(told) > 1:
        head += f", and {told[1]}"
    if gain.held_out_percent <= 0.0:
        return f"{head}: this explains the pairs that were fitted and no others ({figures})"
    if named_mm is not None:
        figures += f", {named_mm:.3g} mm without the smooth model of the rest"
    elif tolerated_mm is not None and tolerated_mm < _BY_TOLERANCES * rms.aligned:
        figures += f", {tolerated_mm:.3g} mm with tolerances alone"
    return f"{head}. RMS error {figures}{_open(verdict, causes)}"


def _open(verdict: Verdict, causes: Sequence[Cause]) -> str:
    """Return the part of a verdict's sentence on what remains open."""
    if verdict == "unexplained":
        return ". Part of the error remains unexplained"
    unsure = [cause for cause in causes if is_unsure(cause)]
    if verdict != "undecided" or not unsure:
        return ""
    named = [f"{c.effect}{'' if c.where is None else f' at {c.where}'}" for c in unsure]
    return f". Not sure: {', '.join(named)}; other causes explain as much"


def is_unsure(cause: Cause) -> bool:
    """Return True for a cause with a rival that is not much less probable."""
    return cause.probability < SURE and bool(cause.rivals)


def _share(gain: Gain) -> str:
    explained = round(gain.held_out_percent)
    return f"{explained} % of the error" if explained > 0 else "less than 1 % of the error"


def made_to(tolerances: Tolerances) -> str:
    """Return one sentence on the manufacturing tolerances of an arm; upper bounds where they do not show."""

    def told(size: Interval, unit: str, sign: str = "") -> str:
        low, high = size.ci95
        if high > _UNTOLD * low:
            return f"{sign}{high:.1g}{unit} or better"
        return f"about {sign}{size.value:.1g}{unit}"

    length, angle = told(tolerances.length_mm, " mm"), told(tolerances.angle_deg, "°")
    drives = told(tolerances.drive_deg, "°", "±")
    return f"The arm is made to {length} and {angle}; its drives run true to {drives}."


def beside_geometry(rms: Errors, alike: Sequence[Alike]) -> list[str]:
    """Return sentences on what the best geometry explains and which effects are confounded; empty if there are none."""
    if rms.geometry is None or not alike:
        return []
    told = [
        f"The best geometry, with every link, zero, the tool and the camera free, brings {rms.aligned:.3g} mm to "
        f"{rms.geometry:.3g} mm. What is left can be described in more than one way:"
    ]
    for pair in alike:
        told.append(
            f"{pair.effect} and {pair.other} at {pair.where} share a direction: alone they explain "
            f"{pair.explains_percent:.0f} % and {pair.other_explains_percent:.0f} % of what is left, and "
            f"{pair.shared_percent:.0f} % of the smaller part is the same (Δχ² = {pair.delta_chi2:.0f} for the first)."
        )
    return told


def modelled(left: Unexplained) -> str:
    """Return one or two sentences on the smooth model in extended.toml; empty if no structure is left."""
    told = []
    if left.model_joints:
        over = "the marker's place" if left.model_joints == PLACE else f"the readings of {', '.join(left.model_joints)}"
        told.append(f"extended.toml has a smooth model of it over {over}, as good as the recording is dense.")
    elif left.what:
        why = "" if left.not_in_model else ": none is right on pairs that it was not fitted to. More pairs may tell one"
        told.append(f"extended.toml has no model of it{why}.")
    if left.not_in_model:
        told.append(
            f"What changes with time is in no such model: {'; '.join(left.not_in_model)}. Another recording will "
            "differ by it again."
        )
    return " ".join(told)


def evidence(standing: Standing) -> str:
    """Return the evidence for a cause in one sentence."""
    text = (
        f"Without it the fit is worse by Δχ² = {standing.gain:.0f} for {standing.dof} number{'s' * (standing.dof > 1)}"
    )
    if not standing.rivals:
        return f"{text}; nothing else comes near."
    rival = standing.rivals[0]
    return f"{text}; the nearest rival: {rival.described} ({100 * rival.probability:.0f} %)."
