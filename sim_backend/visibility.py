"""Check that both cameras truly see the marker at a posture, and that the arm does not collide with the body there."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.pointing import Pointing
from bodyschema.robot.rpy import rotation_of
from kbmaps import RigidChain
from kbmaps.rotations import cross_matrix

from .bullet import Body
from .config import CameraConfig
from .truth import JointRoles, TrueRobot


class _Settings:
    solve_steps: int = 12
    track_gain: float = 0.25
    # The marker stays this far inside the images [px], and between these distances from the eyes [m].
    margin_px: float = 12.0
    nearest_m: float = 0.25
    farthest_m: float = 2.0
    # A tag is shown to the eyes by up to this angle from its normal, so that it can be measured.
    max_oblique: float = np.radians(50.0)
    # Rays begin this far from the eye [m], outside of the head's own shape, and go to the ball's middle and rim.
    ray_start_m: float = 0.06
    rim: float = 0.8
    speed_rad_s: float = 1.5  # greatest speed of each head joint


class Gaze:
    """Solver and tracker of the gazing joints' angles. All angles are reported angles.

    Args:
        robot: the description; the gaze uses only its nominal model.
        joints: indices of the gazing joints in q; may be empty.
    """

    def __init__(self, robot: RobotDescription, calibration: StereoCalibration, joints: tuple[int, ...]) -> None:
        self._robot = robot
        self._joints = list(joints)
        self._pointing = Pointing(calibration, joints, robot.lower[self._joints], robot.upper[self._joints])
        self._chain = robot.chain

    def hold_tool(self, marker_xyz: FloatArray) -> None:
        """Set the marker to `marker_xyz` (3,) [m] in the marker link."""
        self._chain = nominal_chain(self._robot, marker_xyz)

    def solve(self, q: FloatArray) -> FloatArray:
        """Return q (n, d) with the gazing joints turned to the marker, each within its limits."""
        q = q.copy()
        if self._joints:
            for _ in range(_Settings.solve_steps):
                step = self._pointing.step(q, self._chain.positions)
                q[:, self._joints] = self._pointing.clipped(q[:, self._joints] + step)
        return q

    def track(self, q: FloatArray, command: FloatArray, dt: float) -> FloatArray:
        """Return the next command (g,) to the gazing joints' servos, from the reading q (d,) and the last command."""
        if not self._joints:
            return command
        step = _Settings.track_gain * self._pointing.step(q[None], self._chain.positions)[0]
        return self._pointing.clipped(command + np.clip(step, -_Settings.speed_rad_s * dt, _Settings.speed_rad_s * dt))


def nominal_chain(robot: RobotDescription, marker_xyz: FloatArray) -> RigidChain:
    """Return the robot's described chain with its marker at `marker_xyz` (3,) [m] in the marker link."""
    return robot.chain.with_tool(marker_xyz - np.array(robot.robot.marker_xyz))


class Sight:
    """Visibility and clearance checks for postures of the true robot.

    Args:
        body: the true robot in a pybullet world that nothing else uses.
    """

    def __init__(
        self,
        truth: TrueRobot,
        calibration: StereoCalibration,
        roles: JointRoles,
        gaze: Gaze,
        body: Body,
        camera: CameraConfig,
    ) -> None:
        self._truth, self._calibration, self._roles, self._gaze = truth, calibration, roles, gaze
        self._body = body
        self._radius = camera.marker_radius_m
        # Where the tags face, in the chain's last frame, shape (tags, 3); a ball has none.
        turns = [truth.tool_turn @ rotation_of(np.array(tag.rpy)) for tag in camera.tags]
        self._facing = np.array([turn[:, 2] for turn in turns]).reshape(-1, 3)
        self._near_pairs = self._clearance_pairs()
        self._chain = truth.chain(np.array(truth.robot.robot.marker_xyz))

    def hold_tool(self, marker_xyz: FloatArray) -> None:
        """Check for a tool with its marker at `marker_xyz` (3,) [m] from now on."""
        self._chain = self._truth.chain(marker_xyz)

    def gazed(self, q: FloatArray) -> FloatArray:
        """Return q (n, d) with the head turned to the marker."""
        return self._gaze.solve(q)

    def in_images(self, q: FloatArray) -> np.ndarray:
        """Return a mask (n,) of the postures (n, d) with the whole marker inside both images, at a sensible distance.

        At least one tag, if there are tags, must face the eyes.
        """
        T = self._chain.poses(q)
        x = T[:, :3, 3]
        deep = np.maximum(x[:, 2], 1e-3)
        pixels = self._calibration.project(np.column_stack([x[:, :2], deep]))
        border = _Settings.margin_px + self._calibration.focal_px * self._radius / deep
        size = np.tile(self._calibration.image_size_px, 2)
        inside = ((pixels > border[:, None]) & (pixels < size - 1 - border[:, None])).all(axis=1)
        return inside & (x[:, 2] > _Settings.nearest_m) & (x[:, 2] < _Settings.farthest_m) & self._faces_camera(T)

    def _faces_camera(self, T: FloatArray) -> np.ndarray:
        """Return a mask (n,) of the marker's poses (n, 4, 4) with a tag that faces the midpoint between the eyes."""
        if not len(self._facing):
            return np.ones(len(T), dtype=bool)
        away = T[:, :3, 3] - [0.5 * self._calibration.baseline_m, 0.0, 0.0]
        to_eyes = -away / np.linalg.norm(away, axis=1, keepdims=True)
        cosines = np.einsum("nij,kj,ni->nk", T[:, :3, :3], self._facing, to_eyes)
        return cosines.max(axis=1) > np.cos(_Settings.max_oblique)

    def clear(self, q: FloatArray) -> bool:
        """Return True if, at one posture (d,), the ball is not hidden from the eyes and the arm touches nothing."""
        body = self._body
        body.set_angles(q - self._truth.offsets)
        body.bullet.performCollisionDetection(physicsClientId=body.client)
        return not self._blocked(q) and not self._touching()

    def visible(self, q: FloatArray) -> np.ndarray:
        """Return a mask (n,) of the postures (n, d) that pass both checks."""
        seen = self.in_images(q)
        for k in np.flatnonzero(seen):
            seen[k] = self.clear(q[k])
        return seen

    def _blocked(self, q: FloatArray) -> bool:
        T_world_camera = self._body.link_pose(self._truth.robot.camera.parent_link) @ self._truth.T_parent_camera
        x = self._chain.positions(q)
        starts, ends = [], []
        for eye in self._calibration.eyes_m:
            away = (x - eye) / np.linalg.norm(x - eye)
            across = cross_matrix(away) @ (0.0, 1.0, 0.0)
            up = cross_matrix(away) @ across
            for rim in (np.zeros(3), across, -across, up, -up):
                starts.append(eye + _Settings.ray_start_m * away)
                ends.append(x + self._radius * (_Settings.rim * rim - away))
        starts, ends = (
            np.array(points) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3] for points in (starts, ends)
        )
        hits = self._body.bullet.rayTestBatch(starts.tolist(), ends.tolist(), physicsClientId=self._body.client)
        return any(hit[0] == self._body.id for hit in hits)

    def _touching(self) -> bool:
        body = self._body
        return any(
            body.bullet.getClosestPoints(body.id, body.id, 0.0, arm, other, physicsClientId=body.client)
            for arm, other in self._near_pairs
        )

    def _clearance_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of the moving arm's outer links and the links that the arm does not move."""
        tree, body = self._truth.tree, self._body
        first = tree.joints[self._truth.robot.joints[self._roles.guided[0]]]
        arm = _below(tree.joints.values(), first.child)
        outer = _below(tree.joints.values(), self._roles.elbow) - {self._roles.elbow}
        others = [link for link in body.links if link not in arm]
        return [(body.links[link], body.links[other]) for link in sorted(outer) for other in others]


def _below(joints, link: str) -> set[str]:
    found = {link}
    grown = True
    while grown:
        more = {joint.child for joint in joints if joint.parent in found} - found
        grown = bool(more)
        found |= more
    return found
