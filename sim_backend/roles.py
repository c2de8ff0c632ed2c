"""Assign the learnt joints to gaze or guidance, and choose the links that the virtual hand holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.urdf import UrdfTree, chain_between
from kbmaps import RigidChain

from .truth import TrueRobot, with_offsets


@dataclass(frozen=True)
class JointRoles:
    """Roles of the learnt joints in the simulation.

    The path from the cameras to the marker goes up to a common link and then down. Joints on the way up carry the
    cameras: they gaze. Joints on the way down carry the marker: they are guided. If there is no way down (cameras on
    the hand, marker fixed in the world), the joints on the way up are guided.

    Attributes:
        gaze: indices of the gazing joints in q.
        guided: indices of the guided joints in q, in their order from the robot's root.
        wrist: the link that carries the marker (or the hand's cameras); the hand holds it.
        elbow: the link of the guided joint half-way to the wrist, which the other hand holds.
    """

    gaze: tuple[int, ...]
    guided: tuple[int, ...]
    wrist: str
    elbow: str

    @classmethod
    def of(cls, robot: RobotDescription) -> JointRoles:
        """Return the roles of a robot's learnt joints."""
        way = robot.tree.path(robot.camera.parent_link, robot.robot.marker_link)
        upward = {joint.name: up for joint, up in way}
        index = {name: k for k, name in enumerate(robot.joints)}
        gaze = tuple(k for name, k in index.items() if upward[name])
        guided = tuple(k for name, k in index.items() if not upward[name])
        wrist = robot.robot.marker_link
        if not guided:
            gaze, guided, wrist = (), gaze[::-1], robot.camera.parent_link
        elbow = robot.tree.joints[robot.joints[guided[_half_way(robot, guided, wrist)]]].child
        return cls(gaze=gaze, guided=guided, wrist=wrist, elbow=elbow)


def root_link(tree: UrdfTree) -> str:
    """Return the link that is the child of no joint."""
    children = {joint.child for joint in tree.joints.values()}
    return next(link for link in tree.links if link not in children)


def chain_from_root(truth: TrueRobot, roles: JointRoles, link: str) -> tuple[RigidChain, tuple[int, ...]]:
    """Return the true chain from the root to a guided link, over reported angles, and its joints' indices in q."""
    root = root_link(truth.tree)
    on_way = {joint.name for joint, _ in truth.tree.path(root, link)}
    indices = tuple(k for k in roles.guided if truth.robot.joints[k] in on_way)
    names = tuple(truth.robot.joints[k] for k in indices)
    chain = chain_between(truth.tree, names, {}, start=root, end=link, T_start_camera=np.eye(4), marker_xyz=np.zeros(3))
    return with_offsets(chain, truth.offsets[list(indices)]), indices


def _half_way(robot: RobotDescription, guided: tuple[int, ...], wrist: str) -> int:
    """Return the index in `guided` of the joint nearest to half the arm's length, with all joints at zero."""
    links = [*(robot.tree.joints[robot.joints[k]].child for k in guided), wrist]
    origins = np.array([_origin(robot.tree, link) for link in links])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(origins, axis=0), axis=1))])
    return int(np.abs(along[:-1] - along[-1] / 2).argmin())


def _origin(tree: UrdfTree, link: str) -> FloatArray:
    """Return the position (3,) of a link's frame in the root link with all joints at zero [m]."""
    T = np.eye(4)
    for joint, _ in tree.path(root_link(tree), link):
        T = T @ joint.T_parent_joint
    return T[:3, 3]
