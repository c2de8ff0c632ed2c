"""Collect the errors of each joint in the terms of a rigid-body simulator."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from bodyschema.effects.effect import Effect
from bodyschema.effects.simulation import RIGID, Simulation
from bodyschema.robot.urdf import PointMass

_OF_THE_MEASUREMENT = "an error of the measurement, not of the arm"
_WHY_NOT = {
    "settling": "it depends on the moves between readings",
    "hysteresis": "friction whose lag depends on the way is not in a rigid-body simulator",
    "camera_latency": "it depends on time",
    "thermal_drift": "it depends on time",
    "camera_scale": _OF_THE_MEASUREMENT,
    "camera_focal": _OF_THE_MEASUREMENT,
    "lens_distortion": _OF_THE_MEASUREMENT,
}
_UNKNOWN = "this effect has no counterpart there"
HAND_BORE_IT = 'with hold = "torque_free" the guiding hand bore the weight'


def why_not(effect: Effect) -> str:
    """Return the reason why an effect is in no model of the arm."""
    return _WHY_NOT.get(effect.name, _UNKNOWN)


@dataclass(frozen=True)
class Wave:
    """A periodic error: amplitude · cos(frequency · reading - phase).

    Attributes:
        name: name of the effect.
        amplitude: [rad, m].
        phase: [rad].
        frequency: radians per unit of the reading.
    """

    name: str
    amplitude: float
    phase: float
    frequency: float


@dataclass
class JointErrors:
    """Errors between a joint's reading and its true angle.

    Attributes:
        offset: added to the reading [rad, m].
        ratios: share of each joint's reading that is added, by the joint; the joint's own is its scale error.
        waves: periodic errors.
        play: width of the backlash [rad, m].
        loose: width [rad, m] of the backlash under gravity, and the friction [N·m, N] that holds it on its side.
        compliance: [rad/(N·m), m/N].
    """

    offset: float = 0.0
    ratios: dict[str, float] = field(default_factory=dict)
    waves: list[Wave] = field(default_factory=list)
    play: float = 0.0
    loose: tuple[float, float] | None = None
    compliance: float = 0.0

    def take(self, effect: Effect) -> str | None:
        """Add an effect; return the reason if it cannot be added, else None."""
        match effect.name:
            case "joint_offset":
                self.offset += float(effect.values[0])
            case "joint_scale" | "joint_coupling":
                cause = str(effect.source or effect.where)
                self.ratios[cause] = self.ratios.get(cause, 0.0) + float(effect.values[0])
            case "joint_eccentricity" | "joint_ripple":
                self._take_wave(effect)
            case "backlash":
                if self.play or effect.values[0] < 0.0:
                    return "a joint has one backlash there"
                self.play = float(effect.values[0])
            case "gravity_backlash":
                if self.loose or effect.values[0] < 0.0:
                    return "a joint has one backlash under gravity there"
                self.loose = float(effect.values[0]), max(float(effect.values[1]), 0.0)
            case "joint_compliance":
                self.compliance += float(effect.values[0])
            case _:
                return why_not(effect)
        return None

    def _take_wave(self, effect: Effect) -> None:
        sine, cosine = effect.values[:2].tolist()
        cycles = 1.0 if effect.name == "joint_eccentricity" else float(effect.values[2])
        frequency = cycles * (2.0 * np.pi if effect.prismatic else 1.0)
        self.waves.append(Wave(effect.name, float(np.hypot(sine, cosine)), float(np.arctan2(sine, cosine)), frequency))


@dataclass(frozen=True)
class LeftOut:
    """An effect that a format cannot hold, with the reason."""

    effect: Effect
    why: str


def sentences(left_out: Iterable[LeftOut]) -> list[str]:
    """Return one sentence for each kind of effect that is left out."""
    places: dict[tuple[str, str], list[str]] = {}
    for each in left_out:
        effect = each.effect
        source = "" if effect.source is None else f" from {effect.source}"
        places.setdefault((effect.name, each.why), []).append(f"{effect.where}{source}" if effect.where else "")
    told = []
    for (name, why), at in places.items():
        count = f"{len(at)} " if len(at) > 1 else ""
        told.append(f"not in the file: {count}{name}{' at ' if at[0] else ''}{', '.join(dict.fromkeys(at))}: {why}")
    return told


def numbers(effect: Effect) -> str:
    """Return the values of an effect with their names, in readable form."""
    return ", ".join(f"{p.name} = {value:.4g}" for p, value in zip(effect.parameters, effect.values, strict=True))


@dataclass(frozen=True)
class ArmErrors:
    """Effects of a simulation after its moments have passed, sorted by joint.

    Attributes:
        joints: errors of every joint of the robot.
        payloads: masses at the marker's link [kg], and their centres in its frame [m].
        left_out: effects that a rigid-body simulator cannot hold.
        notes: sentences on effects that are held in another form than found.
    """

    simulation: Simulation
    joints: dict[str, JointErrors]
    payloads: tuple[PointMass, ...]
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]

    @classmethod
    def of(cls, simulation: Simulation) -> Self:
        """Sort the effects of a simulation."""
        stayed = simulation.after_moments
        joints = {joint: JointErrors() for joint in simulation.robot.joints}
        payloads: list[PointMass] = []
        left_out: list[LeftOut] = []
        for effect in stayed.all_effects:
            if effect.name in RIGID and effect.name != "joint_offset":
                continue
            if effect.kind.needs_weight and not simulation.bears_weight:
                why = HAND_BORE_IT
            elif effect.name == "payload" and effect.values[0] > 0.0:
                payloads.append(PointMass(float(effect.values[0]), effect.values[1:] / effect.values[0]))
                why = None
            elif effect.where is None:
                why = why_not(effect)
            else:
                why = joints[effect.where].take(effect)
            if why is not None:
                left_out.append(LeftOut(effect, why))
        return cls(stayed, joints, tuple(payloads), tuple(left_out), tuple(moment_notes(simulation)))

    def told(self) -> list[str]:
        """Return sentences on effects that are not in the file, or in another form."""
        told = sentences(self.left_out)
        return [*told, *residual_note(self.simulation), *self.notes]


def residual_note(simulation: Simulation) -> list[str]:
    """Return a sentence on the unexplained part, if there is one."""
    if simulation.residual is None:
        return []
    return ["not in the file: [unexplained]: a learnt map of the readings has no counterpart there"]


def moment_notes(simulation: Simulation) -> Iterator[str]:
    """Yield a sentence on each effect that began at a moment."""
    for effect in simulation.all_effects:
        if effect.kind.begins:
            at = "" if effect.where is None else f" at {effect.where}"
            yield f"{effect.name}{at}: the file has the arm as it is after t0 = {effect.value('t0'):g}"
