"""Ripples of drives: small ones that join the background, and those with aliases in a recording."""

from __future__ import annotations

import numpy as np

from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.net_evidence import WorthSettings, evidence_gain, required_rise
from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray

from .scan import Scan, ScanSettings


class _Settings:
    rounds = 8  # maximum of rounds; each may add one ripple per joint
    apart_turns = 0.75  # ripples whose phases differ by less over a joint's range are the same [turns]
    # Waves whose phases agree this well over all readings are the same wave.
    same_phase = 0.97
    min_cycles = 2


def with_small_ripples(fit: Fit) -> Fit:
    """Add to the background the ripples that the data show and that are no larger than the drive tolerance."""
    scales = fit.background.scales
    if scales is None:
        return fit
    for _ in range(_Settings.rounds):
        robot, scan = fit.simulation.robot, Scan(fit)
        moving = np.flatnonzero(np.ptp(fit.observations.motion.q, axis=0) > 0.0)
        found: list[Effect] = []
        least = 2.0 * required_rise(WorthSettings.named_nats + np.log(len(moving)), 2)
        for k in moving:
            candidate = scan.candidate(Effect.at(robot, "joint_ripple", robot.joints[k]), least)
            if (
                candidate is None
                or not fit.background.is_within_tolerance(candidate.effect)
                or _is_duplicate(fit, candidate.effect)
            ):
                continue
            if (
                evidence_gain(candidate.gain, candidate.dof) - np.log(len(moving) * candidate.trials)
                > WorthSettings.named_nats
            ):
                found.append(candidate.effect)
        if not found:
            break
        fit = fit.with_tolerances(scales, found)
    return fit


def _is_duplicate(fit: Fit, ripple: Effect) -> bool:
    """Return True if a fit already has a ripple of so similar a period that the two could cancel."""
    joint = fit.simulation.robot.joints.index(str(ripple.where))
    span = float(np.ptp(fit.observations.motion.q[:, joint])) / (1.0 if ripple.prismatic else 2.0 * np.pi)
    others = [effect for effect in (*fit.causes, *fit.background.effects) if effect.kind is ripple.kind]
    return any(
        effect.where == ripple.where
        and abs(float(effect.values[-1] - ripple.values[-1])) * span < _Settings.apart_turns
        for effect in others
    )


def alias_sentences(fit: Fit) -> list[str]:
    """Return a sentence for each ripple of a fit that has an alias."""
    sentences = []
    for cause in fit.causes:
        others = aliases(fit, cause) if cause.kind.is_periodic and not cause.prismatic else []
        if others:
            listed = ", ".join(f"{cycles:.0f}" for cycles in others[:3])
            sentences.append(
                f"{cause.where} was read at such regular angles that a ripple of {cause.values[-1]:.0f} cycles a turn "
                f"looks like one of {listed}{' and more' if len(others) > 3 else ''}. Read it at uneven angles."
            )
    return sentences


def aliases(fit: Fit, ripple: Effect) -> list[float]:
    """Return the other numbers of cycles per turn that look the same as a ripple's own at all readings."""
    q = fit.observations.motion.q[:, fit.simulation.place(ripple).joint]
    own = float(ripple.values[-1])
    cycles = np.arange(_Settings.min_cycles, ScanSettings.finest_cycles + 1.0)
    # Compare waves of the same and of opposite phase; close neighbours of a ripple are not aliases.
    same = np.maximum(_agreement(cycles - own, q), _agreement(cycles + own, q)) > _Settings.same_phase
    separate = np.abs(cycles - own) > 2.0 * np.pi / max(float(np.ptp(q)), 1e-6)
    return [float(one) for one in cycles[same & separate]]


def _agreement(cycles: FloatArray, q: FloatArray) -> FloatArray:
    """Return the agreement of waves of frequencies (m,) over readings (n,): 1 if all have the same phase."""
    return np.abs(np.exp(1j * np.multiply.outer(cycles, q)).mean(axis=1))
