"""Backlash in a joint that rests on the flank to which the weight pulls it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects.effect_type import Effect, SimulationRun, StructureEffect
from bodyschema.effects.joint_errors import JointErrors, Rows
from bodyschema.effects.moments import with_moment
from bodyschema.effects.motion import Motion, flanks
from bodyschema.effects.parameter import Parameter, Place
from bodyschema.interfaces.records import FloatArray


class _Settings:
    # Uncertainty factor of the friction, and the smallest relative load that counts.
    friction_within, upright = 2.0, 0.02
    holds = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35)  # frictions tried, as shares of the largest load


class GravityBacklash(StructureEffect):
    """Backlash under load: angle += width/2 · side.

    The side is the sign of gravity's torque, and changes only when that exceeds `hold` in the other direction.
    """

    name = "gravity_backlash"
    rank = 1
    at_joint = True
    needs_weight = True
    moves_joints = True
    search = "load"
    has_slack = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        if prismatic:
            return (Parameter("width_m", 0.002, never_negative=True), Parameter("hold_N", 0.0, None))
        return (Parameter("width_rad", 0.01, never_negative=True), Parameter("hold_Nm", 0.0, None))

    def slack(self, torque: FloatArray, values: FloatArray, side: float) -> tuple[FloatArray, float]:
        sides = flanks(torque, float(values[1]), side)
        return 0.5 * values[0] * sides, float(sides[-1])

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        k = run.simulation.place(effect).joint
        if not run.simulation.bears_weight:
            return np.zeros((len(run.q), 3, 2))
        side = flanks(run.torques[:, k], float(effect.values[1]))
        return with_moment(run.by_joint[:, :, [k]] * 0.5 * side[:, None, None])

    def trial_shapes(self, motion: Motion) -> FloatArray:
        """Return fractions of the largest load."""
        return np.array(_Settings.holds)

    def unknown_state(self, run: SimulationRun, effect: Effect) -> NDArray[np.bool_]:
        """Return rows (n,) at which the side depends on the size of the friction."""
        torque, hold = run.torques[:, run.simulation.place(effect).joint], float(effect.values[1])
        factor, upright = _Settings.friction_within, _Settings.upright
        less, more = hold / factor, hold * factor + upright * float(np.abs(torque).max())
        return flanks(torque, less) != flanks(torque, more)

    def correction_rows(self, effect: Effect, place: Place) -> Rows:
        width, hold = effect.values.tolist()
        return {"loose": [[place.joint, 0.5 * width, hold]]}

    def add_to(self, joint: JointErrors, effect: Effect) -> str | None:
        width, hold = effect.values.tolist()
        if joint.loose or width < 0.0:
            return "a joint has one backlash under gravity there"
        joint.loose = width, max(hold, 0.0)
        return None
