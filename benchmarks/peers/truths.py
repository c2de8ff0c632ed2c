"""True arms: marker positions from physics, independent of every learner.

Only the parameters of a chain are imported; forward kinematics, gravity, encoders and lens are computed here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.humanoid_arm import NECK_JOINTS
from kbmaps import RigidChain
from kbmaps.arrays import FloatArray

_GRAVITY = np.array([0.0, 0.0, -9.81])
_EQUILIBRIUM_STEPS = 6
_POSES = 512
_SLIGHTEST_SHARE = 0.1


class JointEffect(Protocol):
    """Map from encoder readings q to true joint angles."""

    def __call__(self, arm: Arm, q: FloatArray, /) -> FloatArray: ...


class CameraEffect(Protocol):
    """Map from a position in the camera frame to the measured one."""

    def __call__(self, x: FloatArray, /) -> FloatArray: ...


@dataclass(frozen=True)
class Arm:
    """A chain of revolute joints with non-rigid effects.

    Attributes:
        fixed: transforms F_0 .. F_d (d+1, 4, 4); axes: in each joint's frame (d, 3).
        joint_effect, camera_effect: None if the arm is rigid or seen without error.
    """

    fixed: FloatArray
    axes: FloatArray
    joint_effect: JointEffect | None = None
    camera_effect: CameraEffect | None = None

    @classmethod
    def of(
        cls, chain: RigidChain, joint_effect: JointEffect | None = None, camera_effect: CameraEffect | None = None
    ) -> Arm:
        return cls(np.array(chain.fixed), np.array(chain.axes), joint_effect, camera_effect)

    @property
    def joints(self) -> int:
        return len(self.axes)

    def frames(self, joint_angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return rotations (d+1, n, 3, 3) and origins (d+1, n, 3) after F_0 .. F_d, for true joint angles (n, d)."""
        rotation = np.broadcast_to(self.fixed[0, :3, :3], (len(joint_angles), 3, 3))
        origin = np.broadcast_to(self.fixed[0, :3, 3], (len(joint_angles), 3))
        rotations, origins = [rotation], [origin]
        for axis, angles, link in zip(self.axes, joint_angles.T, self.fixed[1:], strict=True):
            turned = rotation @ Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
            origin = origin + turned @ link[:3, 3]
            rotation = turned @ link[:3, :3]
            rotations.append(rotation)
            origins.append(origin)
        return np.stack(rotations), np.stack(origins)

    def positions(self, q: FloatArray, marker_shift: FloatArray | None = None) -> FloatArray:
        """Return the marker positions (n, 3) [m] that the camera measures at encoder readings q (n, d) [rad]."""
        rotations, origins = self.frames(q if self.joint_effect is None else self.joint_effect(self, q))
        x = origins[-1] if marker_shift is None else origins[-1] + rotations[-1] @ marker_shift
        return x if self.camera_effect is None else self.camera_effect(x)


@dataclass(frozen=True)
class Eccentric:
    """Encoder discs mounted off their axes: an error of `size` [rad] · sin(q + phase)."""

    size: float
    phases: FloatArray

    def __call__(self, arm: Arm, q: FloatArray) -> FloatArray:
        del arm
        return q + self.size * np.sin(q + self.phases)


@dataclass(frozen=True)
class GearGain:
    """A gear ratio that differs from the data sheet: the joints turn by `gains` (d,) times the reading."""

    gains: FloatArray

    def __call__(self, arm: Arm, q: FloatArray) -> FloatArray:
        del arm
        return q * self.gains


@dataclass(frozen=True)
class Sag:
    """Joints that deflect under the arm's own weight.

    The torso stands still and the camera turns on it, so gravity is constant in the frame after the neck. One point
    mass is at the end of each link, decreasing towards the hand. Each joint behind the neck has a spring behind its
    encoder, so stiff that the arm's weight turns it by about `most` [rad] when held out. The deflections are the
    equilibrium of the bent arm.

    Attributes:
        most: deflection of a joint under the largest static torque of the rigid arm [rad].
        first: first joint that carries the arm; those before it turn the camera.
        masses: of the links from that joint on [kg].
    """

    most: float
    masses: FloatArray
    first: int = NECK_JOINTS

    @classmethod
    def on(cls, joints: int, most: float, first: int = NECK_JOINTS) -> Sag:
        return cls(most, 2.0 * np.power(0.7, np.arange(joints - first, dtype=np.float64)), first)

    def __call__(self, arm: Arm, q: FloatArray) -> FloatArray:
        poses = np.random.default_rng(0).uniform(-np.pi / 2, np.pi / 2, (_POSES, arm.joints))
        largest = np.abs(self.torques(arm, poses)).max(axis=0)
        # A joint with almost no load, such as a vertical one, does not get an extremely soft spring for it.
        compliance = self.most / np.maximum(largest, _SLIGHTEST_SHARE * largest.max())
        bent = q.copy()
        for _ in range(_EQUILIBRIUM_STEPS):
            turned = compliance * self.torques(arm, bent)
            bent[:, self.first :] = q[:, self.first :] + turned
        return bent

    def torques(self, arm: Arm, joint_angles: FloatArray) -> FloatArray:
        """Return gravity's torque (n, d - first) [N m] about each joint that carries the arm."""
        torso = Arm(np.concatenate([np.eye(4)[None], arm.fixed[self.first + 1 :]]), arm.axes[self.first :])
        rotations, origins = torso.frames(joint_angles[:, self.first :])
        torques = np.zeros((len(joint_angles), torso.joints))
        for k, axis in enumerate(torso.axes):
            levers = origins[k + 1 :] - origins[k]
            weights = self.masses[k:, None, None] * _GRAVITY
            moment = np.cross(levers, np.broadcast_to(weights, levers.shape)).sum(axis=0)
            torques[:, k] = np.einsum("ni,ni->n", moment, rotations[k] @ axis)
        return torques


@dataclass(frozen=True)
class Affine:
    """A stereo rig calibrated with a wrong scale and skew: x -> matrix @ x."""

    matrix: FloatArray

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Affine:
        """Sample scales off by 2 to 3 % and a skew of 1 %."""
        scales = rng.uniform(0.02, 0.03, 3) * rng.choice([-1.0, 1.0], 3)
        return cls(np.eye(3) + np.diag(scales) + np.triu(rng.normal(0.0, 0.01, (3, 3)), 1))

    def __call__(self, x: FloatArray) -> FloatArray:
        return x @ self.matrix.T


@dataclass(frozen=True)
class Radial:
    """Lens distortion left in the calibration: distances from the optical centre grow by `size` at `radius` [m].

    Attributes:
        centre: where the optical axis meets the work space (3,) [m].
    """

    size: float
    radius: float
    centre: FloatArray

    def __call__(self, x: FloatArray) -> FloatArray:
        off = x - self.centre
        squares = np.sum(off * off, axis=1, keepdims=True) / self.radius**2
        return self.centre + off * (1.0 + self.size * squares)
