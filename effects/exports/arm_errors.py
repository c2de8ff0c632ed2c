"""Sort the effects of a simulation by joint, and list those that a rigid-body simulator cannot hold."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from bodyschema.effects.corrected import corrected_geometry
from bodyschema.effects.effect_type import Effect, StructureEffect
from bodyschema.effects.joint_errors import JointErrors
from bodyschema.effects.simulation import Simulation
from bodyschema.robot.calibrated import CalibratedGeometry
from bodyschema.robot.urdf import PointMass

HELD_BY_HAND = 'with hold = "torque_free" the guiding hand bore the weight'
WITHOUT_MASSES = "the URDF states no masses, so nothing pulls at the joint"


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
    summary = []
    for (name, why), at in places.items():
        count = f"{len(at)} " if len(at) > 1 else ""
        summary.append(f"not in the file: {count}{name}{' at ' if at[0] else ''}{', '.join(dict.fromkeys(at))}: {why}")
    return summary


def numbers(effect: Effect) -> str:
    """Return the values of an effect with their names, in readable form."""
    return ", ".join(f"{p.name} = {value:.4g}" for p, value in zip(effect.parameters, effect.values, strict=True))


@dataclass(frozen=True)
class ArmErrors:
    """Effects of a simulation after its moments have passed, sorted by joint."""

    simulation: Simulation
    joints: dict[str, JointErrors]  # errors of every joint of the robot
    # masses on the marker's link that the URDF does not state, their centres in its frame [m]
    payloads: tuple[PointMass, ...]
    left_out: tuple[LeftOut, ...]  # effects that a rigid-body simulator cannot hold
    notes: tuple[str, ...]  # sentences on effects that are held in another form than found

    @classmethod
    def of(cls, simulation: Simulation) -> Self:
        permanent = simulation.with_permanent_changes
        joints = {joint: JointErrors() for joint in simulation.robot.joints}
        payloads: list[PointMass] = []
        left_out: list[LeftOut] = []
        for effect in permanent.all_effects:
            if effect.kind.rigid and not effect.kind.is_zero:
                continue
            if effect.kind.needs_weight and not simulation.bears_weight:
                why = HELD_BY_HAND
            elif effect.kind.needs_weight and not simulation.gravity.known:
                why = WITHOUT_MASSES
            elif isinstance(effect.kind, StructureEffect) and (mass := effect.kind.point_mass(effect.values)):
                payloads.append(mass)
                why = None
            elif effect.where is None:
                why = effect.kind.no_counterpart
            else:
                why = effect.kind.add_to(joints[effect.where], effect)
            if why is not None:
                left_out.append(LeftOut(effect, why))
        return cls(permanent, joints, tuple(payloads), tuple(left_out), tuple(moment_notes(simulation)))

    def summary(self) -> list[str]:
        """Return sentences on effects that are not in the file, or in another form."""
        summary = sentences(self.left_out)
        return [*summary, *residual_note(self.simulation), *self.notes]


def residual_note(simulation: Simulation) -> list[str]:
    if simulation.residual is None:
        return []
    return ["not in the file: [unexplained]: a learnt map of the readings has no counterpart there"]


def moment_notes(simulation: Simulation) -> Iterator[str]:
    """Yield a sentence on each effect that began at a moment and stays."""
    for effect in simulation.all_effects:
        if effect.kind.stays_as is not None:
            at = "" if effect.where is None else f" at {effect.where}"
            yield f"{effect.name}{at}: the file has the arm as it is after t0 = {effect.value('t0'):g}"


def geometry_of(simulation: Simulation) -> CalibratedGeometry:
    """Return the geometry with all effects that it can hold; the described one if there are none."""
    robot = simulation.robot
    described = CalibratedGeometry({}, robot.camera.pose, np.array(robot.robot.marker_xyz))
    return corrected_geometry(simulation) or described


def geometry_without_zeros(simulation: Simulation) -> CalibratedGeometry:
    """Return the geometry without joint offsets."""
    own, background = (
        [effect for effect in effects if not effect.kind.is_zero]
        for effects in (simulation.effects, simulation.background)
    )
    return geometry_of(simulation.with_effects(own).with_background(background))
