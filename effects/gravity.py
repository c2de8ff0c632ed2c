"""Compute gravity's torque about each joint, from the masses in the URDF or, without any, from lengths."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from bodyschema.interfaces.records import FloatArray, frozen_array
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.urdf import REVOLUTE, PointMass, UrdfJoint, UrdfTree, fixed_transform
from kbmaps.rotations import cross_matrix

GRAVITY_M_S2 = 9.80665  # down the root link's z axis, as simulators load a URDF
# Mass per length of the links of a URDF without masses. Any other gives the same sag, with another compliance.
ROD_KG_PER_M = 1.0


@dataclass
class Body:
    """Links between one read joint and the next, which move as one body."""

    joint: UrdfJoint | None  # the joint that carries it; None for the base
    carrier: int | None  # index in q of the joint that carries that joint; None for the base
    T_carrier_joint: FloatArray  # pose (4, 4) of the joint's frame in its carrier's body, at zero
    # mass_kg, moment: its mass and mass times centre of mass [kg·m] (3,), in the frame of the joint's child link
    mass_kg: float = 0.0
    moment: FloatArray = field(default_factory=lambda: np.zeros(3))

    @cached_property
    def across(self) -> FloatArray:
        """The cross-product matrix (3, 3) of its joint's axis."""
        assert self.joint is not None
        return cross_matrix(self.joint.axis)

    @cached_property
    def turns(self) -> FloatArray:
        """Rotations (3, 3, 3) into the carrier, by 1 + sine of the joint's angle + cosine of it (Rodrigues)."""
        over = self.across @ self.across
        return self.T_carrier_joint[:3, :3] @ np.stack([np.eye(3) + over, self.across, -over])


class GravityLoad:
    """Gravity's torques about the joints of a robot, independent of the drives.

    Joints that are not read are at the position where robot.toml holds them. The mass of the tool is unknown and not
    included.

    Args:
        robot: its links have the masses of the URDF; if it states none that a joint bears, each link weighs
            `ROD_KG_PER_M` along straight lines between its joints.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        stated = _bodies(robot, robot.tree.masses)
        # True if the URDF states a mass that a joint bears
        self.known = any(body.mass_kg > 0.0 for k, body in stated.items() if k is not None)
        # by the index in q of the joint that carries them; None is the base
        self.bodies: Mapping[int | None, Body] = stated if self.known else _bodies(robot, _rods(robot))
        # indices in q of the joints, each after the one that carries it
        self.outwards = [k for k in self._order() if k is not None]

    def of_payload(self, mass_kg: float, moment: FloatArray) -> GravityLoad:
        """Return the load of a mass at the marker's link alone.

        Args:
            moment: mass times its position in the link's frame [kg·m], shape (3,).
        """
        carrier, T = self._marker
        load = copy(self)
        load.bodies = {k: Body(body.joint, body.carrier, body.T_carrier_joint) for k, body in self.bodies.items()}
        body = load.bodies[carrier]
        body.mass_kg, body.moment = mass_kg, mass_kg * T[:3, 3] + T[:3, :3] @ moment
        return load

    @cached_property
    def _marker(self) -> tuple[int | None, FloatArray]:
        """The joint that carries the marker's link, and the link's pose (4, 4), as in `carried`."""
        robot = self._robot
        return carried(robot.tree, robot.robot.marker_link, robot.joints, robot.robot.held_at)

    def in_support_frames(self, k: int) -> list[FloatArray]:
        """Return poses (4, 4) of a joint's frame in the links that carry it rigidly: parent link first, farthest last.

        The farthest is the link of the next joint that is read, or the root link. Equal frames are listed once.
        """
        robot = self._robot
        joint, poses = robot.tree.joints[robot.joints[k]], list[FloatArray]()
        for _, T in _carried_links(robot.tree, joint.parent, robot.joints, robot.robot.held_at):
            pose = T @ joint.T_parent_joint
            if not poses or not np.allclose(pose, poses[-1]):
                poses.append(pose)
        return poses

    def torques(self, q: FloatArray) -> FloatArray:
        """Return gravity's torque about each joint, positive in its direction [N·m, or N] (n, d), at q (n, d)."""
        torques = np.zeros_like(q)
        for k, mass, moment, down, _ in self._inwards(q):
            body = self.bodies[k]
            assert body.joint is not None
            if body.joint.kind in REVOLUTE:
                torques[:, k] = np.einsum("in,in->n", body.across @ moment, down)
            else:
                torques[:, k] = mass * (body.joint.axis @ down)
        return torques

    def loads(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gravity's load on the parts a joint carries: moments about its origin [N·m] and forces [N], (n, d, 3).

        Vectors are in the joint's frame on its parent link, at q (n, d).
        """
        moments, forces = np.zeros((2, *q.shape, 3))
        for k, mass, moment, down, turn in self._inwards(q):
            to_joint = self.bodies[k].T_carrier_joint[:3, :3].T
            moments[:, k] = (to_joint @ turn.apply(_cross(moment, down))).T
            forces[:, k] = mass * (to_joint @ turn.apply(down)).T
        return moments, forces

    def _inwards(self, q: FloatArray) -> Iterator[tuple[int, float, FloatArray, FloatArray, _Turn]]:
        """Yield each joint's index, the mass it bears [kg], mass times position [kg·m], gravity [m/s²], and its motion.

        Vectors (3, n) are in the frame of the joint's child link. They pass from frame to frame: gravity outwards, mass
        times centre of mass back.
        """
        turns = {k: _Turn.of(body, q[:, k]) for k, body in self.bodies.items() if k is not None}
        # Components come first in memory, so that each operation covers all rows.
        down: dict[int | None, FloatArray] = {None: np.array([[0.0], [0.0], [-GRAVITY_M_S2]])}
        for k in self.outwards:
            down[k] = turns[k].inverse(down[self.bodies[k].carrier])
        mass = {k: body.mass_kg for k, body in self.bodies.items()}
        moment = {k: body.moment[:, None] for k, body in self.bodies.items()}
        for k in reversed(self.outwards):
            carrier, turn = self.bodies[k].carrier, turns[k]
            yield k, mass[k], moment[k], down[k], turn
            mass[carrier] += mass[k]
            moment[carrier] = moment[carrier] + turn.apply(moment[k]) + mass[k] * turn.origin

    def _order(self) -> list[int | None]:
        order: list[int | None] = [None]
        for carrier in order:
            order += [k for k, body in self.bodies.items() if k is not None and body.carrier == carrier]
        return order


def _bodies(robot: RobotDescription, masses: Mapping[str, PointMass]) -> dict[int | None, Body]:
    tree, held_at = robot.tree, robot.robot.held_at
    bodies: dict[int | None, Body] = {None: Body(None, None, np.eye(4))}
    for name in robot.joints:
        joint = tree.joints[name]
        carrier, T = carried(tree, joint.parent, robot.joints, held_at)
        bodies[robot.joints.index(name)] = Body(joint, carrier, frozen_array(T @ joint.T_parent_joint))
    for link, mass in masses.items():
        carrier, T = carried(tree, link, robot.joints, held_at)
        body = bodies[carrier]
        body.mass_kg += mass.mass_kg
        body.moment = body.moment + mass.mass_kg * (T[:3, :3] @ mass.centre + T[:3, 3])
    return bodies


def _rods(robot: RobotDescription) -> dict[str, PointMass]:
    """Return masses of links that are rods of `ROD_KG_PER_M` from their origin to their joints, and to the marker."""
    ends = [(joint.parent, joint.T_parent_joint[:3, 3]) for joint in robot.tree.joints.values()]
    ends.append((robot.robot.marker_link, np.array(robot.robot.marker_xyz)))
    lengths, moments = dict[str, float](), dict[str, FloatArray]()
    for link, end in ends:
        length = float(np.linalg.norm(end))
        lengths[link] = lengths.get(link, 0.0) + length
        moments[link] = moments.get(link, np.zeros(3)) + 0.5 * length * end
    return {
        link: PointMass(ROD_KG_PER_M * length, moments[link] / length) for link, length in lengths.items() if length > 0
    }


def carried(
    tree: UrdfTree, link: str, joints: tuple[str, ...], held_at: dict[str, float]
) -> tuple[int | None, FloatArray]:
    """Return the read joint that carries `link`, None for the base, and the link's pose (4, 4) in its child link."""
    *_, (joint, T) = _carried_links(tree, link, joints, held_at)
    return None if joint is None else joints.index(joint.name), T


def _carried_links(
    tree: UrdfTree, link: str, joints: tuple[str, ...], held_at: dict[str, float]
) -> Iterator[tuple[UrdfJoint | None, FloatArray]]:
    """Yield the joint above `link` and the link's pose (4, 4) in itself, then the same for each link that bears it.

    The last joint is a read one, or None if the base bears the link.
    """
    above = {joint.child: joint for joint in tree.joints.values()}
    unread = tree.joints.keys() - set(joints)
    T = np.eye(4)
    while True:
        joint = above.get(link)
        yield joint, T
        if joint is None or joint.name not in unread:
            return
        T = fixed_transform(joint, False, held_at.get(joint.name, 0.0)) @ T
        link = joint.parent


@dataclass(frozen=True, eq=False)
class _Turn:
    """Motion of a joint into its carrier's frame."""

    turns: FloatArray  # as in `Body`
    # sine, cosine: of the angle (n,); 0 and 1 for a prismatic joint
    sine: FloatArray
    cosine: FloatArray
    origin: FloatArray  # of the joint's child link in the carrier's frame [m] (3, n)

    @classmethod
    def of(cls, body: Body, q: FloatArray) -> _Turn:
        """Build the motion at q (n,)."""
        assert body.joint is not None
        T = body.T_carrier_joint
        if body.joint.kind in REVOLUTE:
            return cls(body.turns, np.sin(q), np.cos(q), T[:3, 3:])
        slid = T[:3, :3] @ body.joint.axis
        return cls(body.turns, np.zeros(1), np.ones(1), T[:3, 3:] + slid[:, None] * q)

    def apply(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (3, n) in the carrier's frame."""
        return self._mixed(self.turns, vectors)

    def inverse(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (3, n) of the carrier's frame in that of the joint's child link."""
        return self._mixed(self.turns.swapaxes(1, 2), vectors)

    def _mixed(self, turns: FloatArray, vectors: FloatArray) -> FloatArray:
        steady, by_sine, by_cosine = (turns.reshape(9, 3) @ vectors).reshape(3, 3, -1)
        return steady + self.sine * by_sine + self.cosine * by_cosine


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a × b (3, n)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
