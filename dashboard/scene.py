"""The arm at its newest pair: links by the URDF, and the marker where it was measured and predicted."""

from __future__ import annotations

import numpy as np

from bodyschema.daemon.transport.wire import PredictReply
from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.learning.status import ChainCalibration, LearntFigure
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.links import link_poses
from bodyschema.robot.rpy import pose_of
from bodyschema.robot.urdf import MOVING

from .documents import ArmDocument

# Decimals of a coordinate [m] that is sent to the page; links shorter than that are not drawn.
_DECIMALS = 5
_SHORTEST_M = 1e-4


def arm(
    robot: RobotDescription, pair: Pair, calibration: ChainCalibration | None, reply: PredictReply | None
) -> ArmDocument:
    """Return the arm at a pair, in the root link's frame.

    Args:
        calibration: the learnt camera, marker and joint offsets; None for those of robot.toml.
        reply: the learner's prediction at the pair's joint angles; None without one.
    """
    T_camera, marker, q = robot.camera.pose, np.array(robot.robot.marker_xyz), pair.q.copy()
    if calibration is not None:
        T_camera = pose_of(_learnt(calibration.camera_xyz), _learnt(calibration.camera_rpy))
        marker = _learnt(calibration.marker_xyz)
        for k, name in enumerate(robot.joints):
            zero = calibration.zeros.get(name)
            q[k] += 0.0 if zero is None else zero.value
    poses, links, joints = _links(robot, q)
    T_root_camera = poses[robot.camera.parent_link] @ T_camera
    hand = poses[robot.robot.marker_link]
    tip = _moved(hand, marker)
    links.append((hand[:3, 3], tip))
    predicted = None if reply is None else _moved(T_root_camera, np.array(reply.x[0]))
    measured = _moved(T_root_camera, pair.x)
    return ArmDocument(
        pair=pair.seq,
        links=[[_numbers(a), _numbers(b)] for a, b in links if np.linalg.norm(b - a) > _SHORTEST_M],
        joints=[_numbers(place) for place in joints],
        camera=[_numbers(T_root_camera[:3, k]) for k in (3, 0, 1, 2)],
        measured=_numbers(measured),
        predicted=None if predicted is None else _numbers(predicted),
        apart_m=None if predicted is None else float(np.linalg.norm(predicted - measured)),
        placed=calibration is not None or robot.camera.pose_known,
    )


def _learnt(figures: list[LearntFigure]) -> FloatArray:
    return np.array([figure.learnt for figure in figures])


def _links(
    robot: RobotDescription, q: FloatArray
) -> tuple[dict[str, FloatArray], list[tuple[FloatArray, FloatArray]], list[FloatArray]]:
    """Return poses (4, 4) of all links, the lines from joint to joint, and the places of joints that move."""
    poses = {link: pose[0] for link, pose in link_poses(robot, q[None]).items()}
    joints = robot.tree.joints.values()
    lines = [(poses[joint.parent][:3, 3], poses[joint.child][:3, 3]) for joint in joints]
    return poses, lines, [poses[joint.child][:3, 3] for joint in joints if joint.kind in MOVING]


def _moved(T: FloatArray, point: FloatArray) -> FloatArray:
    return T[:3, :3] @ point + T[:3, 3]


def _numbers(point: FloatArray) -> list[float]:
    return point.round(_DECIMALS).tolist()
