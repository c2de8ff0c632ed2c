"""The hidden world: readings and images of a robot with hidden effects, free of noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .arms import Arm
from .arrays import FloatArray, IntArray
from .bullet import Bullet
from .eyes import covariance, triangulate
from .hidden import Hidden, Parameters
from .joints import biased_poles, lag_that_leaves, lagging, off_centre_ring, play, wandering
from .motion import Motion
from .outside import WANDER_CORNERS
from .structure import pose, shift, true_structure


@dataclass(frozen=True)
class Sight:
    """Readings and images of n pairs, free of noise and of quantisation.

    Attributes:
        readings: of the joints [rad or m], shape (n, d).
        at: true marker positions in the true left optical frame [m], shape (n, 3).
        pixels: centres ul, vl, ur, vr [px], shape (n, 4).
        x: positions that the described cameras make of them [m], shape (n, 3).
    """

    readings: FloatArray
    at: FloatArray
    pixels: FloatArray
    x: FloatArray

    def of(self, kept: IntArray) -> Sight:
        """Return the pairs at these indices."""
        return Sight(self.readings[kept], self.at[kept], self.pixels[kept], self.x[kept])


class World:
    """A robot with hidden effects; with none it is the nominal one."""

    def __init__(self, bullet: Bullet, arm: Arm, effects: Sequence[Hidden]) -> None:
        self.arm = arm
        self._effects = effects
        true = true_structure(arm, effects)
        self._true, self.eyes = true, true.eyes
        self._body = bullet.load(true.arm)
        self._columns = [self._body.moving.index(name) for name in arm.read]
        self._compliance = np.array([true.compliance.get(name, 0.0) for name in self._body.moving])

    def close(self) -> None:
        """Take the robot out of pybullet."""
        self._body.remove()

    def measure(self, motion: Motion) -> Sight:
        """Return the readings and images of a motion."""
        taken = motion.stamps - sum(h.parameters["latency_s"] for h in self._named("camera_latency"))
        readings = self.readings(motion.at(motion.shaft, motion.stamps), motion.stamps)
        return self._sight(readings, motion.at(self.outputs(motion), taken), taken)

    def standing(self, shaft: FloatArray, t: FloatArray) -> Sight:
        """Return the readings and images of postures (n, d) at the times (n,) without a preceding motion."""
        return self._sight(self.readings(shaft, t), self._coupled(shaft.copy()), t)

    def marker(self, output: FloatArray, t: FloatArray) -> FloatArray:
        """Return true marker positions in the true left optical frame [m] at joint positions (n, d), shape (n, 3)."""
        moving = np.zeros((len(output), len(self._body.moving)))
        moving[:, self._columns] = output
        for name, (length, tau_s) in self._true.growth.items():
            moving[:, self._body.moving.index(name)] = length * -np.expm1(-t / tau_s)
        if self._compliance.any():
            moving = self._body.balance(moving, self._compliance)
        x, R = self._body.marker_link_poses(moving)
        on_link = np.tile(self._true.arm.marker_xyz, (len(x), 1))
        for h in self._named("tool_slip"):
            on_link += np.where(t >= h.parameters["t0_s"], 1.0, 0.0)[:, None] * shift(h.parameters)
        x = x + np.einsum("nij,nj->ni", R, on_link)
        for h in self._named("camera_moved"):
            eye, turn = pose(h.parameters)
            x = np.where((t >= h.parameters["t0_s"])[:, None], (x - eye) @ turn, x)
        for h in self._named("thermal_drift"):
            x = x + -np.expm1(-t / h.parameters["tau_s"])[:, None] * shift(h.parameters)
        return x

    def readings(self, shaft: FloatArray, t: FloatArray) -> FloatArray:
        """Return encoder readings of shaft positions (n, d) at the times (n,), before they are quantised."""
        read = shaft.copy()
        for index, name in enumerate(self.arm.read):
            for hidden in self._effects:
                if hidden.where == name:
                    read[:, index] = self._read(hidden, read[:, index], shaft, t)
        return read

    def _read(self, hidden: Hidden, read: FloatArray, shaft: FloatArray, t: FloatArray) -> FloatArray:
        p = hidden.parameters
        turn = p.get("turn_m", 2.0 * np.pi) / (2.0 * np.pi)
        match hidden.effect:
            case "joint_eccentricity":
                return turn * off_centre_ring(read / turn, p["ex"], p["ey"])
            case "joint_ripple":
                return turn * biased_poles(read / turn, p["poles"], p["bias_sine"], p["bias_cosine"])
            case "joint_scale":
                return read * (1.0 + p["scale"])
            case "joint_offset":
                return read + next(iter(p.values()))
            case "encoder_jump":
                jump = next(value for name, value in p.items() if name.startswith("jump"))
                return read + np.where(t >= p["t0_s"], jump, 0.0)
            case "square_of_other":
                return read + p["amplitude"] * self._of(hidden.source, shaft) ** 2
            case "product_of_two":
                return read + p["amplitude"] * self._of(hidden.where, shaft) * self._of(hidden.source, shaft)
            case "cable_touches":
                return read + p["amplitude"] * np.tanh((self._of(hidden.source, shaft) - p["at"]) / p["width"])
            case "wandering_zero":
                steps = np.random.default_rng(int(p["seed"])).normal(size=2 * WANDER_CORNERS)
                return read + p["amplitude"] * wandering(t, steps, p["interval_s"])
            case _:
                return read

    def outputs(self, motion: Motion) -> FloatArray:
        """Return true joint positions along the whole path, shape (f, d)."""
        output = motion.shaft.copy()
        for h in self._named("backlash"):
            index = self.arm.read.index(str(h.where))
            output[:, index] = play(output[:, index], next(iter(h.parameters.values())))
        for h in self._named("settling"):
            index = self.arm.read.index(str(h.where))
            output[:, index] = lagging(motion.t, output[:, index], time_constant(h.parameters))
        return self._coupled(output)

    def _coupled(self, output: FloatArray) -> FloatArray:
        before = output.copy()
        for h in self._named("joint_coupling"):
            output[:, self.arm.read.index(str(h.where))] += h.parameters["ratio"] * self._of(h.source, before)
        return output

    def _sight(self, readings: FloatArray, output: FloatArray, t: FloatArray) -> Sight:
        at = self.marker(output, t)
        pixels = self.eyes.project(at)
        return Sight(readings, at, pixels, triangulate(self.arm.eyes, pixels))

    def _named(self, effect: str) -> list[Hidden]:
        return [hidden for hidden in self._effects if hidden.effect == effect]

    def _of(self, joint: str | None, q: FloatArray) -> FloatArray:
        return q[:, self.arm.read.index(str(joint))]


def time_constant(p: Parameters) -> float:
    """Return the time constant of a settling joint [s]."""
    return p["tau_s"] if "tau_s" in p else lag_that_leaves(p["left"], p["move_s"], p["rest_s"])


def residuals(nominal: World, sight: Sight) -> FloatArray:
    """Return seen positions minus those that the nominal robot has at the readings [m], shape (n, 3)."""
    return sight.x - nominal.marker(sight.readings, np.zeros(len(sight.readings)))


def noise(nominal: World, q: FloatArray, pixels: FloatArray, scatter: float) -> FloatArray:
    """Return the covariance [m²] of residuals at readings (n, d), pixels (n, 4), encoder noise included, (n, 3, 3).

    Args:
        scatter: 1-sigma of what encoders scatter before they round [ticks].
    """
    arm, t = nominal.arm, np.zeros(len(q))
    total, here = covariance(arm.eyes, pixels), nominal.marker(q, t)
    for index, name in enumerate(arm.read):
        tick, beside = arm.quantum(name), q.copy()
        beside[:, index] += tick
        step = nominal.marker(beside, t) - here
        # A rounding error is even over one tick.
        total = total + step[:, :, None] * step[:, None, :] * (1.0 / 12.0 + scatter**2)
    return total


def whitened(covariances: FloatArray, x: FloatArray) -> FloatArray:
    """Return vectors (n, 3) in units of their noise with covariances (n, 3, 3)."""
    lower = np.linalg.cholesky(covariances)
    return np.asarray(np.linalg.solve(lower, x[:, :, None])[:, :, 0], dtype=np.float64)
