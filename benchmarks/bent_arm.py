"""Arms that no rigid chain describes: effects of springs, gears and lenses, in sizes found in practice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.rough_arm import RoughArm
from kbmaps.arrays import FloatArray

RIGID = "rigid"
_SAG_RAD = _ECCENTRIC_RAD = np.radians(1.0)
_GAIN, _AFFINE, _RADIAL = 0.01, 0.02, 0.02
# The lens's error is what it is at this distance [m] from the optical axis; the arm reaches about so far.
_FIELD_M = 0.6
_SIZING_POSES = 500

Bend = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class BentArm(RoughArm):
    """A rough arm whose true joint angles differ from the readings, and whose camera distorts.

    Attributes:
        joints: maps readings q (n, d) to the true joint angles (n, d).
        camera: maps marker positions (n, 3) to the measured ones, without noise.
    """

    joints: Bend
    camera: Bend

    def positions(self, q: FloatArray) -> FloatArray:
        return self.camera(super().positions(self.joints(q)))


def bent(arm: RoughArm, kind: str, rng: np.random.Generator) -> RoughArm:
    """Return the arm, rigid or with one non-rigid effect.

    The kinds are "sag" (up to 1 degree a joint under the marker's weight), "eccentric" (encoders off by
    1 degree · sin), "gain" (gears off by 1 %), "affine" (camera off by 2 % a component) and "radial" (2 %, 0.6 m from
    the optical axis).
    """
    if kind == RIGID:
        return arm
    makers = {"sag": _sag, "eccentric": _eccentric, "gain": _gain}
    if kind in makers:
        return BentArm(arm.parameters, arm.change, makers[kind](arm, rng), _same)
    cameras = {"affine": _affine, "radial": _radial}
    return BentArm(arm.parameters, arm.change, _same, cameras[kind](arm, rng))


def _same(values: FloatArray) -> FloatArray:
    return values


def _sag(arm: RoughArm, rng: np.random.Generator) -> Bend:
    """Return joint springs whose deflection is proportional to the torque of a weight at the marker."""
    chain = arm.parameters.chain(arm.change)

    def torques(q: FloatArray) -> FloatArray:
        # The weight pulls along -z, so its torque about a joint equals the rate at which the joint lifts the marker.
        return chain.jacobian(q)[:, 2, :]

    most = np.abs(torques(arm.angles(_SIZING_POSES, 80, rng))).max(axis=0)
    return lambda q: q - _SAG_RAD * torques(q) / np.maximum(most, 1e-9)


def _eccentric(arm: RoughArm, rng: np.random.Generator) -> Bend:
    phase = rng.uniform(-np.pi, np.pi, arm.drawing.joints)
    return lambda q: q + _ECCENTRIC_RAD * np.sin(q + phase)


def _gain(arm: RoughArm, rng: np.random.Generator) -> Bend:
    gain = 1.0 + _GAIN * rng.choice([-1.0, 1.0], arm.drawing.joints)
    return lambda q: q * gain


def _affine(_: RoughArm, rng: np.random.Generator) -> Bend:
    scale = np.eye(3) + _AFFINE * rng.normal(size=(3, 3))
    return lambda x: x @ scale.T


def _radial(_arm: RoughArm, _rng: np.random.Generator) -> Bend:
    # The camera looks along x, at the arm in front of it.
    def distorted(x: FloatArray) -> FloatArray:
        across = np.square(x[:, 1:]).sum(axis=1, keepdims=True) / _FIELD_M**2
        return np.concatenate([x[:, :1], x[:, 1:] * (1.0 + _RADIAL * across)], axis=1)

    return distorted
