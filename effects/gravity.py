"""The torque that gravity exerts about each joint, from the masses that the URDF states."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bodyschema.interfaces.records import FloatArray, frozen_array
from bodyschema.interfaces.robot import RobotDescription
from bodyschema.interfaces.urdf import REVOLUTE, UrdfJoint, UrdfTree, standing
from kbmaps.rotations import cross_matrix

GRAVITY_M_S2 = 9.80665  # down the root link's z axis, as simulators load a URDF


@dataclass
class Body:
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
        self._robot = robot
        self._bodies = _bodies(robot)
        self._outwards = [k for k in self._order() if k is not None]

    @property
    def bodies(self) -> Mapping[int | None, Body]:
        """What moves as one, by the place in q of the joint that carries it; None is the base."""
        return self._bodies

    @property
    def outwards(self) -> Sequence[int]:
        """Places in q of the joints, each after the one that carries it."""
        return self._outwards

    @property
    def known(self) -> bool:
        """Whether the URDF states any mass that a joint bears."""
        return any(body.mass_kg > 0.0 for k, body in self._bodies.items() if k is not None)

    def in_supports(self, k: int) -> list[FloatArray]:
        """Poses (4, 4) of a joint's frame in the links that carry it as one: its parent link first, the farthest last.

        The farthest is the link of the next joint that is read, or the root link. Frames that are the same are one.
        """
        robot = self._robot
        joint, poses = robot.tree.joints[robot.joints[k]], list[FloatArray]()
        for _, T in _borne(robot.tree, joint.parent, robot.joints, robot.robot.held_at):
            pose = T @ joint.T_parent_joint
            if not poses or not np.allclose(pose, poses[-1]):
                poses.append(pose)
        return poses

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

        In the joint's frame on its parent link, at q (n, d). Vectors are handed from frame to frame: gravity outwards,
        mass times centre of mass back.
        """
        turns = {k: _Turn.of(body.joint, q[:, k]) for k, body in self._bodies.items() if body.joint is not None}
        # Components first: what is done to a component of all rows is done at once.
        down: dict[int | None, FloatArray] = {None: np.array([[0.0], [0.0], [-GRAVITY_M_S2]])}
        for k in self._outwards:
            body = self._bodies[k]
            down[k] = turns[k].inverse(body.T_carrier_joint[:3, :3].T @ down[body.carrier])
        mass = {k: body.mass_kg for k, body in self._bodies.items()}
        moment = {k: body.moment[:, None] for k, body in self._bodies.items()}
        moments, forces = np.zeros((2, *q.shape, 3))
        for k in reversed(self._outwards):
            body = self._bodies[k]
            turn, T = turns[k], body.T_carrier_joint
            lever, downward = turn.apply(moment[k]), T[:3, :3].T @ down[body.carrier]
            moments[:, k] = _cross(lever, downward).T
            forces[:, k] = mass[k] * downward.T
            mass[body.carrier] += mass[k]
            at_carrier = T[:3, :3] @ (lever + mass[k] * turn.slide) + mass[k] * T[:3, 3:]
            moment[body.carrier] = moment[body.carrier] + at_carrier
        return moments, forces

    def _order(self) -> list[int | None]:
        order: list[int | None] = [None]
        for carrier in order:
            order += [k for k, body in self._bodies.items() if k is not None and body.carrier == carrier]
        return order


def _bodies(robot: RobotDescription) -> dict[int | None, Body]:
    tree, held_at = robot.tree, robot.robot.held_at
    bodies: dict[int | None, Body] = {None: Body(None, None, np.eye(4))}
    for name in robot.joints:
        joint = tree.joints[name]
        carrier, T = carried(tree, joint.parent, robot.joints, held_at)
        bodies[robot.joints.index(name)] = Body(joint, carrier, frozen_array(T @ joint.T_parent_joint))
    for link, mass in tree.masses.items():
        carrier, T = carried(tree, link, robot.joints, held_at)
        body = bodies[carrier]
        body.mass_kg += mass.mass_kg
        body.moment = body.moment + mass.mass_kg * (T[:3, :3] @ mass.centre + T[:3, 3])
    return bodies


def carried(
    tree: UrdfTree, link: str, joints: tuple[str, ...], held_at: dict[str, float]
) -> tuple[int | None, FloatArray]:
    """The read joint that carries `link`, None for the base, and the link's pose (4, 4) in that joint's child link."""
    *_, (joint, T) = _borne(tree, link, joints, held_at)
    return None if joint is None else joints.index(joint.name), T


def _borne(
    tree: UrdfTree, link: str, joints: tuple[str, ...], held_at: dict[str, float]
) -> Iterator[tuple[UrdfJoint | None, FloatArray]]:
    """The joint above `link` and the link's pose (4, 4) in itself, then the same of each link that bears it as one.

    The last joint is one that is read, or None where the base bears the link.
    """
    above = {joint.child: joint for joint in tree.joints.values()}
    T = np.eye(4)
    while True:
        joint = above.get(link)
        yield joint, T
        if joint is None or joint.name in joints:
            return
        T = standing(joint, False, held_at.get(joint.name, 0.0)) @ T
        link = joint.parent


@dataclass(frozen=True, eq=False)
class _Turn:
    """A joint's own motion: a turn about a fixed axis, and a slide (3, n).

    Attributes:
        across, over: the matrices (3, 3) of a product with the axis, once and twice.
        sine, versine: sin and 1 - cos of the angle (n,).
        slide: along the axis [m] (3, n).
    """

    across: FloatArray
    over: FloatArray
    sine: FloatArray
    versine: FloatArray
    slide: FloatArray

    @classmethod
    def of(cls, joint: UrdfJoint, q: FloatArray) -> _Turn:
        """At q (n,)."""
        across = cross_matrix(joint.axis)
        if joint.kind in REVOLUTE:
            return cls(across, across @ across, np.sin(q), 1.0 - np.cos(q), np.zeros((3, 1)))
        return cls(across, across @ across, np.zeros(1), np.zeros(1), joint.axis[:, None] * q)

    def apply(self, vectors: FloatArray) -> FloatArray:
        """Vectors (3, n) turned (Rodrigues)."""
        return vectors + self.sine * (self.across @ vectors) + self.versine * (self.over @ vectors)

    def inverse(self, vectors: FloatArray) -> FloatArray:
        """Vectors (3, n) turned back."""
        return vectors - self.sine * (self.across @ vectors) + self.versine * (self.over @ vectors)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a × b (3, n)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
