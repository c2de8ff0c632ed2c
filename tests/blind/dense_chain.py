"""Forward kinematics of an arm with tolerances, Jacobians by every joint frame, and gravity torques."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from .arms import Arm
from .arrays import FloatArray

GRAVITY = np.array([0.0, 0.0, -9.81])
SPRING_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Built:
    """An arm with its true frames, springs, marker and instrument.

    Attributes:
        frames: small motion of each read joint's frame, shift [m] and rotation vector [rad], shape (d, 6).
        soft: of each read joint [rad/(N·m) or m/N], shape (d,).
        marker: in the marker's link [m], shape (3,) or one for each row (n, 3).
        eye_R, eye_x: pose of the measurement frame in its link, (3, 3) and (3,) [m].
    """

    arm: Arm
    frames: FloatArray
    marker: FloatArray
    eye_R: FloatArray
    eye_x: FloatArray
    soft: FloatArray = field(default_factory=lambda: np.zeros(0))

    def balanced(self, positions: FloatArray) -> FloatArray:
        """Return positions (n, d) of the joints under the arm's own weight."""
        if not self.soft.any():
            return positions
        loaded = positions
        for _ in range(SPRING_ROUNDS):
            loaded = positions + self.soft * Posture.of(self, loaded).torques()
        return loaded

    def measured(self, positions: FloatArray) -> FloatArray:
        """Return the marker (n, 3) [m] in the measurement frame at true joint positions (n, d)."""
        return Posture.of(self, positions).seen()


@dataclass(frozen=True, eq=False)
class Posture:
    """All links at n rows.

    Attributes:
        R, x: of each link in the world, (n, 3, 3) and (n, 3) [m].
        before: orientation (n, 3, 3) of each read joint's frame before the joint moves.
    """

    built: Built
    R: dict[str, FloatArray]
    x: dict[str, FloatArray]
    before: dict[str, FloatArray]

    @classmethod
    def of(cls, built: Built, positions: FloatArray) -> Posture:
        """Return the links at joint positions (n, d)."""
        arm, n = built.arm, len(positions)
        root = arm.joints[0].parent
        R, x, before = {root: np.tile(np.eye(3), (n, 1, 1))}, {root: np.zeros((n, 3))}, {}
        for joint in arm.joints:
            at = x[joint.parent] + R[joint.parent] @ np.array(joint.xyz)
            turned = R[joint.parent] @ Rotation.from_euler("xyz", joint.rpy).as_matrix()
            if joint.name in arm.read:
                index = arm.read.index(joint.name)
                shift, turn = built.frames[index, :3], built.frames[index, 3:]
                at = at + turned @ shift
                turned = turned @ Rotation.from_rotvec(turn).as_matrix()
                before[joint.name] = turned
                move = positions[:, index, None] * np.array(joint.axis)
                if joint.kind == "prismatic":
                    at = at + np.einsum("nij,nj->ni", turned, move)
                else:
                    turned = turned @ Rotation.from_rotvec(move).as_matrix()
            R[joint.child], x[joint.child] = turned, at
        return cls(built, R, x, before)

    def eye(self) -> tuple[FloatArray, FloatArray]:
        """Return orientation (n, 3, 3) and position (n, 3) of the measurement frame in the world."""
        link = self.built.arm.camera_link
        return self.R[link] @ self.built.eye_R, self.x[link] + self.R[link] @ self.built.eye_x

    def marker(self) -> FloatArray:
        """Return the marker in the world (n, 3) [m]."""
        link = self.built.arm.marker_link
        on_link = np.broadcast_to(self.built.marker, self.x[link].shape)
        return self.x[link] + np.einsum("nij,nj->ni", self.R[link], on_link)

    def seen(self) -> FloatArray:
        """Return the marker in the measurement frame (n, 3) [m]."""
        R, x = self.eye()
        return np.einsum("nji,nj->ni", R, self.marker() - x)

    def by_marker(self) -> FloatArray:
        """Return the derivative (n, 3, 3) of `seen` with respect to the marker's position in its link."""
        return np.swapaxes(self.eye()[0], 1, 2) @ self.R[self.built.arm.marker_link]

    def by_eye(self) -> FloatArray:
        """Return the derivative (n, 3, 6) of `seen` with respect to a motion of the measurement frame in itself."""
        seen = self.seen()
        turns = np.stack([-np.cross(axis, seen) for axis in np.eye(3)], axis=2)
        return np.concatenate([np.tile(-np.eye(3), (len(seen), 1, 1)), turns], axis=2)

    def by_frames(self) -> FloatArray:
        """Return the derivative (n, 3, d, 6) of `seen` with respect to a local motion of each read joint's frame."""
        arm = self.built.arm
        columns = []
        for name in arm.read:
            joint = arm.joint(name)
            along = self.before[name]
            # A prismatic joint's frame turns about its position before the motion.
            place = self.x[joint.child] - self._slid(name)
            turns = np.cross(np.swapaxes(along, 1, 2), (self.marker() - place)[:, None])
            columns.append(self._toward(name) * np.concatenate([along, np.swapaxes(turns, 1, 2)], axis=2))
        R = self.eye()[0]
        return np.einsum("nji,njdk->nidk", R, np.stack(columns, axis=2))

    def by_joints(self) -> FloatArray:
        """Return the derivative (n, 3, d) of `seen` with respect to the joints' true positions."""
        arm = self.built.arm
        columns = []
        for name in arm.read:
            joint = arm.joint(name)
            axis = self.before[name] @ np.array(joint.axis)
            turn = np.cross(axis, self.marker() - self.x[joint.child])
            columns.append(self._toward(name) * (axis if joint.kind == "prismatic" else turn))
        return np.einsum("nji,njd->nid", self.eye()[0], np.stack(columns, axis=2))

    def torques(self) -> FloatArray:
        """Return gravity's torque [N·m] or force [N] along each read joint's axis (n, d), positive in its direction."""
        arm = self.built.arm
        out = []
        for name in arm.read:
            joint = arm.joint(name)
            axis = self.before[name] @ np.array(joint.axis)
            pull = np.zeros_like(axis)
            for link in _beyond(arm, joint.child):
                if link not in arm.masses:
                    continue
                weight = arm.masses[link].kg * GRAVITY
                centre = self.x[link] + self.R[link] @ np.array(arm.masses[link].centre)
                lever = centre - self.x[joint.child]
                pull += weight if joint.kind == "prismatic" else np.cross(lever, weight)
            out.append(np.einsum("ni,ni->n", axis, pull))
        return np.stack(out, axis=1)

    def _slid(self, name: str) -> FloatArray:
        arm = self.built.arm
        joint = arm.joint(name)
        if joint.kind != "prismatic":
            return np.zeros_like(self.x[joint.child])
        parent_R, parent_x = self.R[joint.parent], self.x[joint.parent]
        turned = parent_R @ Rotation.from_euler("xyz", joint.rpy).as_matrix()
        index = arm.read.index(name)
        begun = parent_x + parent_R @ np.array(joint.xyz) + turned @ self.built.frames[index, :3]
        return self.x[joint.child] - begun

    def _toward(self, name: str) -> float:
        """Return +1 for a joint that carries the marker, -1 for one that carries the instrument."""
        return 1.0 if self.built.arm.marker_link in _beyond(self.built.arm, self.built.arm.joint(name).child) else -1.0


def _beyond(arm: Arm, link: str) -> list[str]:
    """Return a link and all its descendants."""
    links = [link]
    for joint in arm.joints:  # parents come before children
        if joint.parent in links:
            links.append(joint.child)
    return links
