"""The arm at its newest pair: poses of its links, and the measured and the predicted marker."""

from __future__ import annotations

import numpy as np

from bodyschema.daemon.transport.status import LearnerStatus
from bodyschema.daemon.transport.wire import PredictReply
from bodyschema.dashboard.recent import RecentSettings
from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.robot.description import RobotDescription, link_poses
from bodyschema.robot.hand_eye import MarkerPose
from bodyschema.robot.rpy import pose_of
from kbmaps.rotations import quaternions

from .documents import ArmDocument

# Half axes of the ellipsoid that holds 95 % of a normal distribution in space, in units of its 1-sigma: the root of the
# chi-squared distribution's quantile for three degrees of freedom.
_RADIUS_95 = 2.7955


def arm(
    robot: RobotDescription, pairs: list[Pair], learner: LearnerStatus | None, reply: PredictReply | None
) -> ArmDocument:
    """Return the arm at a pair, in the root link's frame.

    Args:
        pairs: the pair, which is the last one, and those before it, whose markers are its trail.
        learner: its state, with the learnt camera pose and joint offsets; None for those of robot.toml.
        reply: the learner's prediction at the pair's joint angles; None without one.
    """
    calibration = None if learner is None else learner.calibration
    noise_m = None if learner is None else learner.noise_m()
    T_camera = robot.camera.pose
    q, x = np.array([pair.q for pair in pairs]), np.array([pair.x for pair in pairs])
    if calibration is not None:
        figures = (calibration.camera_xyz, calibration.camera_rpy)
        T_camera = pose_of(*(np.array([figure.learnt for figure in each]) for each in figures))
        for k, name in enumerate(robot.joints):
            zero = calibration.zeros.get(name)
            q[:, k] += 0.0 if zero is None else zero.value
    poses = link_poses(robot, q)
    T_root_cameras = poses[robot.camera.parent_link] @ T_camera
    measured = np.einsum("nij,nj->ni", T_root_cameras[:, :3, :3], x) + T_root_cameras[:, :3, 3]
    newest = np.array([poses[link][-1] for link in robot.tree.links])
    R, place = T_root_cameras[-1, :3, :3], T_root_cameras[-1, :3, 3]
    predicted = None if reply is None else R @ np.array(reply.x[0]) + place
    radii = None
    if reply is not None and noise_m is not None:
        radii = (_RADIUS_95 * np.hypot(np.array(reply.sigma[0]), noise_m)).tolist()
    return ArmDocument(
        pair=pairs[-1].seq,
        links=_pose_numbers(newest),
        camera=_pose_numbers(T_root_cameras[-1:])[0],
        hand=robot.tree.links.index(robot.robot.marker_link),
        measured=measured[-1].round(RecentSettings.decimals).tolist(),
        trail=measured[:-1].round(RecentSettings.decimals).tolist(),
        predicted=None if predicted is None else predicted.round(RecentSettings.decimals).tolist(),
        measured_pose=MarkerPose.of(pairs[-1].x, pairs[-1].cov, pairs[-1].R, pairs[-1].cov_R),
        predicted_pose=None if reply is None or reply.poses is None else reply.poses[0],
        radii=radii,
        apart_m=None if predicted is None else float(np.linalg.norm(predicted - measured[-1])),
        placed=calibration is not None or robot.camera.pose_known,
    )


def _pose_numbers(T: FloatArray) -> list[list[float]]:
    """Return poses (n, 4, 4) as x, y, z and the quaternion's x, y, z, w."""
    return np.hstack([T[:, :3, 3], quaternions(T[:, :3, :3])]).round(RecentSettings.decimals).tolist()
