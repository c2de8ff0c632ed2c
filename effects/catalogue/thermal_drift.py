"""A measured position that drifts slowly, settling."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.effect_type import Effect, SimulationRun, TimeEffect
from bodyschema.effects.moments import drift_share, with_moment
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter, shifts
from bodyschema.interfaces.records import FloatArray


class _Settings:
    shortest = 0.03  # a drift that ends within a smaller share of the recording is an offset from the beginning
    time_constants = np.geomspace(shortest, 4.0, 24)  # time constants tried, as shares of the recording's duration


class ThermalDrift(TimeEffect):
    """A shift of the measurements that grows from 0 towards its amounts, with a time constant."""

    name = "thermal_drift"
    rank = 1
    drifts = True
    search = "shape"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (*shifts(0.01), Parameter("time_constant_s", 600.0, None, smooth=True, positive=True))

    def drift(self, motion: Motion, values: FloatArray) -> FloatArray:
        return self.growth(motion, values[3])[:, None] * values[:3]

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        return with_moment(self.growth(run.motion, effect.values[3])[:, None, None] * np.eye(3))

    def growth(self, motion: Motion, shape: float) -> FloatArray:
        return drift_share(motion, float(shape))

    def trial_shapes(self, motion: Motion) -> FloatArray:
        return float(motion.clock[-1] - motion.clock[0]) * _Settings.time_constants

    def bounded(self, effect: Effect, k: int, value: float, motion: Motion) -> float:
        shortest = _Settings.shortest * float(motion.clock[-1] - motion.clock[0])
        return super().bounded(effect, k, max(value, shortest), motion)
