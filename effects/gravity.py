"""The torque that gravity exerts about each joint, from the masses that the URDF states."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from interfaces.records import FloatArray, frozen_array
from interfaces.robot import RobotDescription
from interfaces.urdf import REVOLUTE, UrdfJoint, UrdfTree, standing
from kbmaps.rotations import exponentials

GRAVITY_M_S2 = 9.80665  # down the root link's z axis, as simulators load a URDF


@dataclass
class _Body:
    """The links between one joint that is read and the next: they move as one.

    Attributes:
        joint: the joint that carries it; None for the base.
        carrier: the joint, by its place in q, that carries that joint; None for the base.
        T_carrier_joint: pose (4, 4) of the joint's frame in its carrier's body, at zero.
        mass_kg, moment: its mass and mass times centre of mass [kg·m] (3,), in the frame of the joint's child link.
    """

    joint: UrdfJoint | None
    carrier: int | None
    T_carrier_joint: FloatArray
    mass_kg: float = 0.0
    moment: FloatArray = field(default_factory=lambda: np.zeros(3))


class GravityLoad:
    """Gravity's torques about the joints of a robot, whatever holds them.

    Joints that are not read stand where robot.toml holds them. The tool's mass is not known and not counted.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._joints = robot.joints
        self._bodies = _bodies(robot)
        self._outwards = [k for k in self._order() if k is not None]

    @property
    def known(self) -> bool:
        """Whether the URDF states any mass that a joint bears."""
        return any(body.mass_kg > 0.0 for k, body in self._bodies.items() if k is not None)

    def torques(self, q: FloatArray) -> FloatArray:
        """Torque of gravity about each joint, in the direction in which it counts [N·m, or N] (n, d), at q (n, d)."""
        moments, forces = self.loads(q)
        torques = np.zeros_like(q)
        for k in self._outwards:
            joint = self._bodies[k].joint
            assert joint is not None
            torques[:, k] = (moments if joint.kind in REVOLUTE else forces)[:, k] @ joint.axis
        return torques

    def loads(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What gravity does to all that each joint carries: moments about its origin [N·m] and forces [N], (n, d, 3).

        In the joint's frame on its parent link, at q (n, d).
        """
        poses = self._poses(q)
        mass = {k: body.mass_kg for k, body in self._bodies.items()}
        moment = {
            k: body.mass_kg * poses[k][:, :3, 3] + poses[k][:, :3, :3] @ body.moment for k, body in self._bodies.items()
        }
        moments, forces = np.zeros((2, *q.shape, 3))
        for k in reversed(self._outwards):
            body = self._bodies[k]
            turn = (poses[body.carrier] @ body.T_carrier_joint)[:, :3, :3]
            lever = moment[k] - mass[k] * poses[k][:, :3, 3]
            down = np.array([0.0, 0.0, -GRAVITY_M_S2])
            moments[:, k] = np.einsum("nij,ni->nj", turn, np.cross(lever, down))
            forces[:, k] = np.einsum("nij,i->nj", turn, mass[k] * down)
            mass[body.carrier] = mass[body.carrier] + mass[k]
            moment[body.carrier] = moment[body.carrier] + moment[k]
        return moments, forces

    def _poses(self, q: FloatArray) -> dict[int | None, FloatArray]:
        """Pose (n, 4, 4) of each body in the root link."""
        poses: dict[int | None, FloatArray] = {None: np.broadcast_to(np.eye(4), (len(q), 4, 4))}
        for k in self._outwards:
            body = self._bodies[k]
            assert body.joint is not None
            poses[k] = poses[body.carrier] @ body.T_carrier_joint @ _motions(body.joint, q[:, k])
        return poses

    def _order(self) -> list[int | None]:
        order: list[int | None] = [None]
        for carrier in order:
            order += [k for k, body in self._bodies.items() if k is not None and body.carrier == carrier]
        return order


def _bodies(robot: RobotDescription) -> dict[int | None, _Body]:
    tree, held_at = robot.tree, robot.robot.held_at
    bodies: dict[int | None, _Body] = {None: _Body(None, None, np.eye(4))}
    for name in robot.joints:
        joint = tree.joints[name]
        carrier, T = _carried(tree, joint.parent, robot.joints, held_at)
        bodies[robot.joints.index(name)] = _Body(joint, carrier, frozen_array(T @ joint.T_parent_joint))
    for link, mass in tree.masses.items():
        carrier, T = _carried(tree, link, robot.joints, held_at)
        body = bodies[carrier]
        body.mass_kg += mass.mass_kg
        body.moment = body.moment + mass.mass_kg * (T[:3, :3] @ mass.centre + T[:3, 3])
    return bodies


def _carried(
    tree: UrdfTree, link: str, joints: tuple[str, ...], held_at: dict[str, float]
) -> tuple[int | None, FloatArray]:
    """The read joint that carries `link`, None for the base, and the link's pose (4, 4) in that joint's child link."""
    above = {joint.child: joint for joint in tree.joints.values()}
    T = np.eye(4)
    while link in above:
        joint = above[link]
        if joint.name in joints:
            return joints.index(joint.name), T
        T = standing(joint, False, held_at.get(joint.name, 0.0)) @ T
        link = joint.parent
    return None, T


def _motions(joint: UrdfJoint, q: FloatArray) -> FloatArray:
    """The joint's own motion (n, 4, 4) at q (n,)."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    if joint.kind in REVOLUTE:
        T[:, :3, :3] = exponentials(q[:, None] * joint.axis)[0]
    else:
        T[:, :3, 3] = q[:, None] * joint.axis
    return T
