"""A link whose length, shift or axis differs from the URDF."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.effect_type import Effect, SimulationRun, StructureEffect
from bodyschema.effects.motion import moved_and_turned, rotation, transforms
from bodyschema.effects.parameter import Parameter, shifts, turns
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.urdf import inverse


class LinkGeometry(StructureEffect):
    """A joint's frame on its parent link, moved by a shift and a rotation vector in the nominal frame."""

    name = "link_geometry"
    rank = 3
    at_joint = True
    rigid = True
    in_parts = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (*shifts(0.005), *turns(0.02))

    def frame(self, values: FloatArray) -> FloatArray:
        return transforms(values[None])[0]

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        k = run.simulation.place(effect).joint
        turn, by_turn = rotation(effect.values)
        if run.simulation.upward[k]:
            # Frame after the joint's own motion, in which the link above begins.
            frame, turn = run.frames[:, k + 1] @ inverse(run.chain.fixed[k + 1]), -turn
        else:
            frame = run.frames[:, k]
        both = frame[:, :3, :3].reshape(-1, 3) @ np.concatenate([turn.T, turn.T @ by_turn], axis=1)
        axes, turned = np.split(both.reshape(-1, 3, 6), 2, axis=2)
        return run.seen(moved_and_turned(axes, turned, run.x_true - frame[:, :3, 3]))
