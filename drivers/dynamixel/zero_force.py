"""Zero-force mode: the servos' currents carry the arm, so that it can be guided by hand without its weight."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from bodyschema.drivers.servos.channel import Sample
from bodyschema.drivers.servos.servo import IdentifiedServo
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, frozen_array

from .config import DynamixelConfig
from .guard import Currents, Drop, Guard, GuardLimits, GuardSettings
from .models import CURRENT_MODES
from .powered import PoweredJoints
from .powered_config import ZeroForceConfig

HoldingTorques = Callable[[FloatArray], FloatArray]
"""From the angles of all joints [rad] (d,) the torques about them that hold the arm where it is [N·m] (d,)."""


class ZeroForce(PoweredJoints):
    """Joints that carry the arm by current; see `PoweredJoints`. The torque of other joints stays off."""

    name, goal = "zero_force", "goal_current"
    mode, mode_name = CURRENT_MODES["current"], "current control"

    def __init__(
        self,
        config: DynamixelConfig,
        zero_force: ZeroForceConfig,
        joints: Sequence[str],
        torques: HoldingTorques,
        clock: Clock,
    ) -> None:
        floating = [joint for joint in joints if joint in zero_force.joints]
        servos = {servo.joint: servo for servo in config.servos}
        limit = frozen_array([zero_force.joints[joint].current_limit_a for joint in floating])
        limits = GuardLimits(
            joints=tuple(floating),
            heartbeat_s=zero_force.heartbeat_s,
            max_speed=np.full(len(floating), math.radians(zero_force.max_speed_deg_s)),
            current_limit=limit,
            max_temperature_c=zero_force.max_temperature_c,
        )
        super().__init__(zero_force, floating, Guard(limits), clock)
        constants = frozen_array([zero_force.torque_constant_of(servos[joint]) for joint in floating])
        self._limit, self._torques = limit, torques
        self._currents = Currents(floating, constants, limit, zero_force.share)
        self._saturated_s = math.inf
        self._sinking: tuple[str, ...] = ()

    @property
    def complaints(self) -> tuple[str, ...]:
        messages = super().complaints
        if self.state == "on" and self._sinking:
            names = ", ".join(self._sinking)
            messages += (f"zero_force: the current limit of {names} does not bear the arm here: it sinks. Hold it",)
        return messages

    def _prepare(self, servo: IdentifiedServo) -> int:
        ticks = self._ticks(servo, self._limit[self._joints.index(servo.joint)])
        allowed = self._read(servo, "current_limit")
        if abs(ticks) > allowed:
            unit = servo.model.current_unit or math.nan
            raise RequestError(
                f"joint {servo.joint!r} (ID {servo.id}): its own Current Limit is {allowed * unit:.2f} A. Give at most "
                "that as current_limit_a, or type: "
                f"`bodyschema servos current_limit={abs(ticks)} --joint {servo.joint}`"
            )
        return 0

    def _begin(self, now: float) -> None:
        self._currents.begin(now)
        self._saturated_s, self._sinking = math.inf, ()

    def _goals(self, now: float, q: FloatArray, samples: Mapping[str, Sample | None]) -> list[int]:
        del samples
        try:
            torques = np.asarray(self._torques(q), dtype=np.float64)[self._places]
        except Exception as error:  # without a torque model the arm cannot be carried safely
            raise Drop(f"the model of the arm's weight failed: {error!r}") from error
        currents = self._currents.at(now, torques)
        saturated = self._currents.saturated
        self._saturated_s = min(self._saturated_s, now) if saturated else math.inf
        self._sinking = saturated if now - self._saturated_s > GuardSettings.saturated_s else ()
        return [self._ticks(servo, current) for servo, current in zip(self._servos, currents, strict=True)]

    def _on_message(self) -> str:
        return (
            f"zero_force is on: within {GuardSettings.ramp_s:.0f} s {', '.join(self._joints)} bear the arm. Hold it "
            "until then, and stay ready to hold it: any doubt switches torque off"
        )

    @staticmethod
    def _ticks(servo: IdentifiedServo, current: float) -> int:
        """Return the register value of a current [A] that turns the joint forward."""
        return round(servo.direction * current / (servo.model.current_unit or math.nan))
