"""An encoder magnet or disc off the axis of its joint."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.effect_type import Effect
from bodyschema.effects.encoder import EncoderEffect
from bodyschema.effects.joint_errors import JointErrors, Rows
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter, Place
from bodyschema.interfaces.records import FloatArray


class _Settings:
    # Upper limit of a magnet's eccentricity as a share of its radius; beyond it the encoder cannot be read.
    farthest_off = 0.95
    # Samples of a turn for its Fourier series, and the amplitude [rad] below which a term is rounding.
    samples, negligible_rad = 256, 1e-15


class JointEccentricity(EncoderEffect):
    """Encoder magnet off the axis by (sine, -cosine) of its radius.

    The field has the direction of (cos θ, sin θ) + e, so true angle = reading + asin(sine · sin + cosine · cos).
    """

    name = "joint_eccentricity"
    rank = 2
    turns_only = True
    of_drive = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("sine_rad", 0.02), Parameter("cosine_rad", 0.02))

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        ring = self._ring(motion, place)
        return ring / np.sqrt(1.0 - np.square(self._sine(ring, values)))[:, None]

    def correction(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        return np.arcsin(self._sine(self._ring(motion, place), values))

    def correction_rows(self, effect: Effect, place: Place) -> Rows:
        """Return its Fourier series; the waves of an eccentric magnet are the odd harmonics."""
        sine, cosine = effect.values.tolist()
        phase = float(np.arctan2(cosine, sine))
        t = np.arange(_Settings.samples) * 2.0 * np.pi / _Settings.samples
        error = np.arcsin(np.clip(np.hypot(sine, cosine) * np.sin(t), -_Settings.farthest_off, _Settings.farthest_off))
        harmonics = np.arange(1, _Settings.samples // 2, 2)
        amplitudes = 2.0 / _Settings.samples * np.sin(np.outer(harmonics, t)) @ error
        series = [
            (int(n), float(size))
            for n, size in zip(harmonics, amplitudes, strict=True)
            if abs(size) > _Settings.negligible_rad
        ]
        return {"waves": [[place.joint, size, n, n * phase] for n, size in series]}

    def add_to(self, joint: JointErrors, effect: Effect) -> None:
        joint.add_wave(self.name, effect.values, 1.0)

    def _ring(self, motion: Motion, place: Place) -> FloatArray:
        q = motion.q[:, place.joint]
        return np.stack([np.sin(q), np.cos(q)], axis=1)

    def _sine(self, ring: FloatArray, values: FloatArray) -> FloatArray:
        return np.clip(ring @ values, -_Settings.farthest_off, _Settings.farthest_off)
