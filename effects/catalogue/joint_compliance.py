"""A joint that deflects under the arm's weight."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.effect_type import Effect, SimulationRun, StructureEffect
from bodyschema.effects.joint_errors import JointErrors
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray


class JointCompliance(StructureEffect):
    """A spring at a joint: angle += compliance · (torque of gravity about the joint)."""

    name = "joint_compliance"
    rank = 0
    at_joint = True
    needs_weight = True
    moves_joints = True
    is_spring = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        if prismatic:
            return (Parameter("compliance_m_per_N", 1e-5, never_negative=True),)
        return (Parameter("compliance_rad_per_Nm", 0.001, never_negative=True),)

    def compliance(self, values: FloatArray) -> float:
        return float(values[0])

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        k = run.simulation.place(effect).joint
        if not run.simulation.bears_weight:
            return np.zeros((len(run.q), 3, 1))
        return run.by_joint[:, :, [k]] * run.torques[:, None, [k]]

    def add_to(self, joint: JointErrors, effect: Effect) -> None:
        joint.compliance += float(effect.values[0])
