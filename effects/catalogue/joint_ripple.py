"""A periodic error of a drive, finer than a turn."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.effect_type import Effect, SimulationRun
from bodyschema.effects.encoder import EncoderEffect
from bodyschema.effects.joint_errors import JointErrors, Rows
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter, Place
from bodyschema.interfaces.records import FloatArray


class _Settings:
    of_a_peak_rad = 0.5  # largest step of the phase over the joint's range [rad]
    min_cycles = 1.5  # at once per turn it would be an eccentricity


class JointRipple(EncoderEffect):
    """Periodic error of gear teeth, strain wave or pole pairs; its period is a fraction of a turn, or a length."""

    name = "joint_ripple"
    rank = 3
    of_drive = True
    search = "cycles"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        if prismatic:
            cycles = Parameter("cycles_per_m", 100.0, None, smooth=True, positive=True)
            return (Parameter("sine_m", 0.001), Parameter("cosine_m", 0.001), cycles)
        cycles = Parameter("cycles_per_turn", 8.0, None, smooth=True, positive=True)
        return (Parameter("sine_rad", 0.01), Parameter("cosine_rad", 0.01), cycles)

    @property
    def most_at_one_place(self) -> int:
        # Teeth, strain wave, pole pairs and a screw have different periods.
        return 4

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        phase = motion.q[:, place.joint] * values[2] * (2.0 * np.pi if place.prismatic else 1.0)
        columns = np.zeros((len(phase), 3))
        columns[:, 0], columns[:, 1] = np.sin(phase), np.cos(phase)
        return columns

    def shape_step(self, run: SimulationRun, effect: Effect, k: int) -> float:
        return _Settings.of_a_peak_rad / max(float(np.ptp(run.readings.q[:, run.simulation.place(effect).joint])), 1e-6)

    def bounded(self, effect: Effect, k: int, value: float, motion: Motion) -> float:
        return super().bounded(effect, k, value if effect.prismatic else max(value, _Settings.min_cycles), motion)

    def correction_rows(self, effect: Effect, place: Place) -> Rows:
        sine, cosine, cycles = effect.values.tolist()
        # The format has radians per unit of the reading.
        frequency = cycles * (2.0 * np.pi if effect.prismatic else 1.0)
        return {"waves": [[place.joint, float(np.hypot(sine, cosine)), frequency, float(np.arctan2(cosine, sine))]]}

    def add_to(self, joint: JointErrors, effect: Effect) -> None:
        joint.add_wave(self.name, effect.values, float(effect.values[2]) * (2.0 * np.pi if effect.prismatic else 1.0))
