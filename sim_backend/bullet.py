"""A robot in its own pybullet world; pybullet is imported only when needed."""

from __future__ import annotations

import importlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.extras import missing
from bodyschema.interfaces.records import FloatArray
from kbmaps.rotations import cross_matrix


class PhysicsUrdf(msgspec.Struct, frozen=True):
    """A URDF and its meshes, which lie beside it."""

    text: str  # the URDF
    meshes: dict[str, bytes] = {}  # files by name
    said: tuple[str, ...] = ()  # differences from the robot's own URDF, in sentences


def load_pybullet() -> Any:
    """Import and return the module pybullet; raise ConfigError if it is not installed."""
    try:
        with _quiet():
            return importlib.import_module("pybullet")
    except ImportError as error:
        raise missing("pybullet", "sim", "the simulation") from error


class Body:
    """One robot in its own pybullet world. All angles are true angles of the named joints.

    Args:
        joints: names of the joints of `set_angles` and `angles`.
        gravity: downward acceleration [m/s²].
        dt: length of one step [s].
    """

    def __init__(
        self, urdf: PhysicsUrdf, joints: tuple[str, ...], *, gravity: float = 9.81, dt: float = 1 / 240
    ) -> None:
        self._urdf, self._names = urdf, joints
        self._gravity, self.dt = gravity, dt
        self.bullet: Any = None
        self.client = -1
        self.id = -1
        self.links: dict[str, int] = {}
        self.joints: list[int] = []
        self._order = self._place = np.zeros(0, dtype=np.int64)

    def __enter__(self) -> Self:
        self.bullet = load_pybullet()
        self.client = self.bullet.connect(self.bullet.DIRECT)
        with tempfile.TemporaryDirectory(prefix="bodyschema_") as folder:
            file = Path(folder, "robot.urdf")
            file.write_text(self._urdf.text, encoding="utf-8")
            for name, data in self._urdf.meshes.items():
                Path(folder, name).write_bytes(data)
            self.id = self._load(file)
        count = self.bullet.getNumJoints(self.id, physicsClientId=self.client)
        info = [self.bullet.getJointInfo(self.id, k, physicsClientId=self.client) for k in range(count)]
        self.links = {row[12].decode(): row[0] for row in info}
        by_name = {row[1].decode(): row[0] for row in info}
        self.joints = [by_name[name] for name in self._names]
        # pybullet's dynamics count joints in the order of their numbers.
        self._order = np.argsort(self.joints)
        self._place = np.argsort(self._order)
        self.bullet.setGravity(0, 0, -self._gravity, physicsClientId=self.client)
        self.bullet.setTimeStep(self.dt, physicsClientId=self.client)
        return self

    def __exit__(self, *_: object) -> None:
        self.bullet.disconnect(physicsClientId=self.client)
        self.client = -1

    def set_angles(self, angles: FloatArray) -> None:
        """Set the joints to `angles` (n,) [rad or m], at rest."""
        for joint, angle in zip(self.joints, angles, strict=True):
            self.bullet.resetJointState(self.id, joint, angle, 0.0, physicsClientId=self.client)

    def angles(self) -> FloatArray:
        """Return the true angles (n,) [rad or m]."""
        states = self.bullet.getJointStates(self.id, self.joints, physicsClientId=self.client)
        return np.array([state[0] for state in states])

    def stands(self, link: str) -> bool:
        """Return True if no joint moves the link."""
        index = self.links[link]
        while index >= 0:
            info = self.bullet.getJointInfo(self.id, index, physicsClientId=self.client)
            if info[2] != self.bullet.JOINT_FIXED:
                return False
            index = info[16]
        return True

    def link_pose(self, link: str) -> FloatArray:
        """Return the pose (4, 4) of a link's URDF frame in the world."""
        state = self.bullet.getLinkState(
            self.id, self.links[link], computeForwardKinematics=1, physicsClientId=self.client
        )
        return self._pose(state)

    def link_motion(self, link: str) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the pose (4, 4) of a link's URDF frame, and its linear [m/s] and angular velocity [rad/s], each (3,).

        The linear velocity is that of the frame's origin.
        """
        state = self.bullet.getLinkState(
            self.id, self.links[link], computeLinkVelocity=1, computeForwardKinematics=1, physicsClientId=self.client
        )
        T = self._pose(state)
        spin = np.array(state[7])
        # v + ω × r from the centre of mass to the frame's origin
        return T, np.array(state[6]) + cross_matrix(spin) @ (T[:3, 3] - np.array(state[0])), spin

    def _pose(self, state: Any) -> FloatArray:
        T = np.eye(4)
        T[:3, :3] = np.array(self.bullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        T[:3, 3] = state[4]
        return T

    def mass_matrix(self, angles: FloatArray) -> FloatArray:
        """Return the joint-space inertia (n, n) [kg·m² or kg] at the angles (n,)."""
        M = self.bullet.calculateMassMatrix(self.id, angles[self._order].tolist(), physicsClientId=self.client)
        return np.array(M)[np.ix_(self._place, self._place)]

    def jacobians(self, link: str, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the linear and the angular Jacobian (3, n) of a link's centre of mass at the angles (n,)."""
        zero = [0.0] * len(angles)
        linear, angular = self.bullet.calculateJacobian(
            self.id, self.links[link], zero[:1] * 3, angles[self._order].tolist(), zero, zero,
            physicsClientId=self.client,
        )  # fmt: skip
        return np.array(linear)[:, self._place], np.array(angular)[:, self._place]

    def gravity_torques(self, angles: FloatArray) -> FloatArray:
        """Return the torques (n,) [N·m or N] that compensate gravity at the angles (n,)."""
        zero = [0.0] * len(angles)
        torques = self.bullet.calculateInverseDynamics(
            self.id, angles[self._order].tolist(), zero, zero, physicsClientId=self.client
        )
        return np.array(torques)[self._place]

    def _load(self, file: Path) -> int:
        try:
            return self.bullet.loadURDF(str(file), useFixedBase=True, physicsClientId=self.client)
        except self.bullet.error as error:
            raise ConfigError(f"pybullet cannot load the robot's URDF: {error}") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the build time that pybullet prints to standard error from C when it is imported."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
