"""A mass at the hand that the URDF does not state."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.effect_type import Effect, SimulationRun, StructureEffect
from bodyschema.effects.gravity import GravityLoad
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.urdf import PointMass


class Payload(StructureEffect):
    """A mass on the marker's link, and its moment; visible only if joints deflect."""

    name = "payload"
    rank = 2
    needs_weight = True
    is_load = True
    no_counterpart = "without a mass there is no body for it"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        mass = Parameter("mass_kg", 1.0, never_negative=True)
        return (mass, *(Parameter(f"{axis}_kgm", 0.05) for axis in "xyz"))

    def load(self, gravity: GravityLoad, values: FloatArray) -> GravityLoad | None:
        return gravity.of_payload(float(values[0]), values[1:]) if values.any() else None

    def point_mass(self, values: FloatArray) -> PointMass | None:
        return PointMass(float(values[0]), values[1:] / values[0]) if values[0] > 0.0 else None

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        simulation, springs = run.simulation, run.simulation.springs
        if not (springs.any() and simulation.bears_weight):
            return np.zeros((len(run.q), 3, len(effect.values)))
        units = [simulation.gravity.of_payload(float(one[0]), one[1:]) for one in np.eye(len(effect.values))]
        return np.stack([run.by_joint @ (springs * one.torques(run.q))[:, :, None] for one in units], axis=2)[..., 0]
