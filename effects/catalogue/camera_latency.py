"""Images with late timestamps."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.effect_type import Effect, SimulationRun, TimeEffect
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray


class CameraLatency(TimeEffect):
    """Delay of the images' timestamps against the encoders."""

    name = "camera_latency"
    rank = 0
    moves_joints = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("latency_s", 0.02),)

    @property
    def depends_on_path(self) -> bool:
        return True

    def delay_s(self, values: FloatArray) -> float:
        return float(values[0])

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        # Include the encoder errors, which also belong to the earlier moment.
        simulation, latency = run.simulation, run.simulation.latency_s
        step_s = 1e-5
        later, sooner = (simulation.unloaded(run.motion.earlier(latency + s)) for s in (step_s, -step_s))
        return np.einsum("nij,nj->ni", run.by_joint, (later - sooner) / (2.0 * step_s))[:, :, None]
