"""The simulator's ground truth: the described robot with random errors from the seed. Not for the learner."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from bodyschema.effects import Effect, Simulation
from bodyschema.effects.effect_type import ToolEffect
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, frozen_array
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.urdf import MOVING, UrdfJoint, UrdfTree, chain_between, joint_motion
from kbmaps import RigidChain

from .config import SimConfig
from .geometry import rotation, transform
from .randomness import Stream, generator


@dataclass(frozen=True)
class TrueRobot:
    robot: RobotDescription  # its description, the nominal model
    beyond: Simulation  # the robot with those effects, and the residual, that no rigid chain can represent
    # its true kinematics; joints that are not learnt are locked (kind fixed, their position in their origin)
    tree: UrdfTree
    offsets: FloatArray  # reported minus true angle [rad or m], shape (d,), in the order of `robot.joints`
    T_parent_camera: FloatArray  # true pose of the left eye in the camera's parent link, shape (4, 4)
    tool_error: FloatArray  # true minus described position of the marker in the marker link [m], shape (3,)
    tool_turn: FloatArray  # rotation of the marker in the marker link, shape (3, 3); the description has no rotation

    @classmethod
    def draw(cls, robot: RobotDescription, config: SimConfig, extension: Simulation | None = None) -> TrueRobot:
        """Sample the true robot; the same arguments give the same robot.

        Args:
            extension: the robot with effects, to which the random errors are added; None for no effects.
        """
        extension = Simulation(robot) if extension is None else extension
        rng = generator(config.seed, Stream.ERRORS)
        errors = config.errors
        path = [joint.name for joint, _ in robot.tree.path(robot.camera.parent_link, robot.robot.marker_link)]
        moving = [name for name in path if robot.tree.joints[name].kind in MOVING]
        offsets: dict[str, float] = {}
        metres_per_radian = 0.1  # the offset of a prismatic joint is known better than that of a revolute one
        for name in moving:
            scale = metres_per_radian if robot.tree.joints[name].kind == "prismatic" else 1.0
            offsets[name] = float(scale * errors.joint_offset_rad * rng.standard_normal())
        for effect in extension.all_effects:
            if effect.kind.is_zero:
                offsets[effect.where or ""] -= effect.values[0]
        joints = dict(robot.tree.joints)
        for place, moved in extension.link_moves:
            joint = joints[robot.joints[place]]
            joints[joint.name] = replace(joint, T_parent_joint=frozen_array(joint.T_parent_joint @ moved))
        for name in moving:
            error = _pose_error(errors.link_length_m, errors.link_axis_rad, rng)
            joints[name] = replace(joints[name], T_parent_joint=frozen_array(joints[name].T_parent_joint @ error))
        camera_error = _pose_error(errors.camera_position_m, errors.camera_rotation_rad, rng)
        tool_error = errors.tool_m * rng.standard_normal(3)
        for effect in extension.all_effects:
            if effect.kind.rigid and isinstance(effect.kind, ToolEffect):
                tool_error = tool_error + effect.kind.shift(effect.values)
        tool_turn = rotation(errors.tool_rotation_rad * rng.standard_normal(3))
        for name, joint in joints.items():
            if joint.kind in MOVING and name not in robot.joints:
                held_at = robot.robot.held_at.get(name, 0.0) - offsets.get(name, 0.0)
                joints[name] = _locked(joint, held_at)
        return cls(
            robot=robot,
            beyond=extension.with_effects(_beyond_rigid(extension.effects)).with_background(
                _beyond_rigid(extension.background)
            ),
            tree=replace(robot.tree, joints=joints),
            offsets=frozen_array([offsets[name] for name in robot.joints]),
            T_parent_camera=frozen_array(robot.camera.pose @ extension.camera_pose @ camera_error),
            tool_error=frozen_array(tool_error),
            tool_turn=frozen_array(tool_turn),
        )

    def true_calibration(self, calibration: StereoCalibration) -> StereoCalibration:
        """Return the described calibration with the true baseline."""
        return replace(calibration, baseline_m=calibration.baseline_m / (1.0 + self.beyond.optics.scale_error))

    def marker(self, marker_xyz: FloatArray) -> FloatArray:
        """Return the true position (3,) [m] in the marker link of a marker described at `marker_xyz` (3,)."""
        return marker_xyz + self.tool_error

    def chain(self, marker_xyz: FloatArray) -> RigidChain:
        """Return the true chain from left eye to marker over reported angles, for a tool at `marker_xyz` (3,) [m].

        The effects in `beyond` are not included.
        """
        chain = chain_between(
            self.tree,
            self.robot.joints,
            {},
            start=self.robot.camera.parent_link,
            end=self.robot.robot.marker_link,
            T_start_camera=self.T_parent_camera,
            marker_xyz=self.marker(marker_xyz),
        )
        return with_offsets(chain, self.offsets)


def with_offsets(chain: RigidChain, offsets: FloatArray) -> RigidChain:
    """Convert a chain over true angles to one over reported angles = true angles + offsets (d,)."""
    fixed = chain.fixed.copy()
    for k, offset in enumerate(offsets):
        fixed[k + 1] = joint_motion(chain.axes[k], bool(chain.prismatic[k]), -offset) @ fixed[k + 1]
    return RigidChain(fixed=fixed, axes=chain.axes, prismatic=chain.prismatic)


def _beyond_rigid(effects: Iterable[Effect]) -> list[Effect]:
    """Return the effects that no tree of rigid links can represent."""
    return [effect for effect in effects if not effect.kind.rigid]


def _pose_error(length: float, angle: float, rng: np.random.Generator) -> FloatArray:
    shift, turn = length * rng.standard_normal(3), angle * rng.standard_normal(3)
    return transform(turn, shift)


def _locked(joint: UrdfJoint, position: float) -> UrdfJoint:
    motion = joint_motion(joint.axis, joint.kind == "prismatic", position)
    return replace(joint, kind="fixed", T_parent_joint=frozen_array(joint.T_parent_joint @ motion))


@dataclass(frozen=True)
class JointRoles:
    """Roles of the learnt joints in the simulation.

    The path from the cameras to the marker goes up to a common link and then down. Joints on the way up carry the
    cameras: they gaze. Joints on the way down carry the marker: they are guided. If there is no way down (cameras on
    the hand, marker fixed in the world), the joints on the way up are guided.
    """

    gaze: tuple[int, ...]  # indices of the gazing joints in q
    guided: tuple[int, ...]  # indices of the guided joints in q, in their order from the robot's root
    wrist: str  # the link that carries the marker (or the hand's cameras); the hand holds it
    elbow: str  # the link of the guided joint half-way to the wrist, which the other hand holds

    @classmethod
    def of(cls, robot: RobotDescription) -> JointRoles:
        """Return the roles of a robot's learnt joints."""
        path = robot.tree.path(robot.camera.parent_link, robot.robot.marker_link)
        upward = {joint.name: is_upward for joint, is_upward in path}
        index = {name: k for k, name in enumerate(robot.joints)}
        gaze = tuple(k for name, k in index.items() if upward[name])
        guided = tuple(k for name, k in index.items() if not upward[name])
        wrist = robot.robot.marker_link
        if not guided:
            gaze, guided, wrist = (), gaze[::-1], robot.camera.parent_link
        # The joint nearest to half the arm's length, with all joints at zero.
        links = [*(robot.tree.joints[robot.joints[k]].child for k in guided), wrist]
        origins = np.array([_origin(robot.tree, link) for link in links])
        distances = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(origins, axis=0), axis=1))])
        elbow = links[int(np.abs(distances[:-1] - distances[-1] / 2).argmin())]
        return cls(gaze=gaze, guided=guided, wrist=wrist, elbow=elbow)


def chain_from_root(truth: TrueRobot, roles: JointRoles, link: str) -> tuple[RigidChain, tuple[int, ...]]:
    """Return the true chain from the root to a guided link, over reported angles, and its joints' indices in q."""
    root = truth.tree.root
    on_path = {joint.name for joint, _ in truth.tree.path(root, link)}
    indices = tuple(k for k in roles.guided if truth.robot.joints[k] in on_path)
    names = tuple(truth.robot.joints[k] for k in indices)
    chain = chain_between(truth.tree, names, {}, start=root, end=link, T_start_camera=np.eye(4), marker_xyz=np.zeros(3))
    return with_offsets(chain, truth.offsets[list(indices)]), indices


def _origin(tree: UrdfTree, link: str) -> FloatArray:
    """Return the position (3,) of a link's frame in the root link with all joints at zero [m]."""
    T = np.eye(4)
    for joint, _ in tree.path(tree.root, link):
        T = T @ joint.T_parent_joint
    return T[:3, 3]
