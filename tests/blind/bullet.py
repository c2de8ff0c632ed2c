"""The marker's position and the joint torques under gravity, computed by pybullet."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pybullet
from scipy.spatial.transform import Rotation

from .arms import Arm, urdf
from .arrays import FloatArray

GRAVITY = 9.81
MOST_ROUNDS, AT_REST = 60, 1e-12


class Body:
    """An arm loaded into pybullet.

    Attributes:
        moving: every joint that moves, in pybullet's order; springs and other joints that are not read are among them.
    """

    def __init__(self, client: int, arm: Arm, file: Path) -> None:
        file.write_text(urdf(arm), encoding="utf-8")
        self._client = client
        self._body = pybullet.loadURDF(
            str(file), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
        )
        count = pybullet.getNumJoints(self._body, physicsClientId=client)
        infos = [pybullet.getJointInfo(self._body, index, physicsClientId=client) for index in range(count)]
        names = [info[1].decode() for info in infos]
        links = {info[12].decode(): info[0] for info in infos}
        self.moving = tuple(name for name in names if arm.joint(name).moves)
        self._indices = [names.index(name) for name in self.moving]
        self._marker, self._camera = links[arm.marker_link], links.get(arm.camera_link)
        self._centres = [np.array(arm.mass(link).centre) for link in (arm.marker_link, arm.camera_link)]
        self._T_link_camera = (np.array(arm.camera_xyz), Rotation.from_euler("xyz", arm.camera_rpy).as_matrix())

    def marker_link_poses(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the pose of the marker's link in the camera's frame: positions (n, 3), rotations (n, 3, 3).

        Args:
            q: positions of `moving` [rad or m], shape (n, number of moving joints).
        """
        links = [self._marker] if self._camera is None else [self._marker, self._camera]
        states = np.array([self._mass_states(row, links) for row in q.tolist()])
        R = Rotation.from_quat(states[:, 0, 3:]).as_matrix()
        x = states[:, 0, :3] - R @ self._centres[0]
        c, R_camera = self._T_link_camera
        if self._camera is None:
            return (x - c) @ R_camera, R_camera.T @ R
        R_link = Rotation.from_quat(states[:, 1, 3:]).as_matrix()
        eye = states[:, 1, :3] + R_link @ (c - self._centres[1])
        R_world_camera = R_link @ R_camera
        return np.einsum("nij,ni->nj", R_world_camera, x - eye), np.einsum("nij,nik->njk", R_world_camera, R)

    def balance(self, q: FloatArray, compliance: FloatArray) -> FloatArray:
        """Return the joint positions at which compliant joints come to rest under the arm's weight, shape as q.

        Args:
            q: positions with no load [rad or m], shape (n, number of moving joints).
            compliance: of each joint [rad/(N·m) or m/N].
        """
        rows = []
        still = [0.0] * len(self.moving)
        for unloaded in q:
            bent = unloaded
            for _ in range(MOST_ROUNDS):
                bearing = pybullet.calculateInverseDynamics(
                    self._body, bent.tolist(), still, still, physicsClientId=self._client
                )
                new = unloaded - compliance * bearing  # the external load is opposite to the torque that holds it
                settled = np.abs(new - bent).max() < AT_REST
                bent = new
                if settled:
                    break
            else:
                raise ValueError("the springs are too soft to bear the arm")
            rows.append(bent)
        return np.array(rows)

    def remove(self) -> None:
        """Take the body out of pybullet."""
        pybullet.removeBody(self._body, physicsClientId=self._client)

    def _mass_states(self, q: list[float], links: list[int]) -> list[list[float]]:
        """Return positions and orientations (quaternions x, y, z, w) of the links' centres of mass."""
        pybullet.resetJointStatesMultiDof(
            self._body, self._indices, [[value] for value in q], physicsClientId=self._client
        )
        states = pybullet.getLinkStates(self._body, links, computeForwardKinematics=True, physicsClientId=self._client)
        # The pose of the centre of mass is exact; that of the link's frame went through single precision.
        return [[*state[0], *state[1]] for state in states]


class Bullet:
    """One pybullet client without a window, and a folder for the URDFs that it loads."""

    def __init__(self, client: int, folder: Path) -> None:
        self._client, self._folder = client, folder

    def load(self, arm: Arm) -> Body:
        """Load the arm as a body of this client."""
        return Body(self._client, arm, self._folder / "arm.urdf")


@contextmanager
def bullet() -> Iterator[Bullet]:
    """Yield a pybullet client that is closed when the context ends."""
    client = pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
        # Otherwise an arm written over the file of another would come out as that other one.
        pybullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
        with tempfile.TemporaryDirectory() as folder:
            yield Bullet(client, Path(folder))
    finally:
        pybullet.disconnect(client)
