"""Compute the content of a frame: the robot's posture and the marker's apparent position in each eye."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyschema.effects import Motion, Simulation
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.sim_backend.bullet import Body
from bodyschema.sim_backend.truth import TrueRobot


@dataclass(frozen=True, slots=True)
class Scene:
    """Content of a frame."""

    angles: FloatArray  # true joint angles [rad or m], shape (d,)
    T_world_camera: FloatArray  # pose of the left eye, shape (4, 4)
    x_world: FloatArray  # centre of the ball [m], shape (3,)
    tip: FloatArray  # the same point in the marker link, the end of the tool [m], shape (3,)
    # its apparent position in each eye's optical frame [m], shape (eyes, 3); the true one unless the lenses differ from
    # the calibration
    x_eyes: FloatArray
    R_camera_marker: FloatArray  # orientation of the marker in the left eye's optical frame, shape (3, 3)
    x_seen: FloatArray  # position that an ideal tracker with the described calibration reports [m], shape (3,)


def scene_of(
    body: Body, truth: TrueRobot, marker_xyz: FloatArray, calibration: StereoCalibration, row: Motion
) -> Scene:
    """Return the scene of a body in its current posture, with its tool's marker described at `marker_xyz` (3,) [m].

    Args:
        row: encoder readings at the frame's time, one row.
    """
    robot, beyond = truth.robot, truth.beyond
    T_world_hand = body.link_pose(robot.robot.marker_link)
    tip = truth.marker(marker_xyz) + beyond.tool_shift(row)[0]
    T_world_placed = body.link_pose(robot.camera.parent_link) @ truth.T_parent_camera
    T_world_camera = T_world_placed @ beyond.camera_moves(row)[0]
    x_world = T_world_hand[:3, :3] @ tip + T_world_hand[:3, 3]
    x_camera = T_world_camera[:3, :3].T @ (x_world - T_world_camera[:3, 3])
    x_eyes, x_seen = _through_lenses(beyond, calibration, x_camera, row)
    R_camera_marker = T_world_camera[:3, :3].T @ T_world_hand[:3, :3] @ truth.tool_turn
    return Scene(body.angles(), T_world_camera, x_world, tip, x_eyes, R_camera_marker, x_seen)


def _through_lenses(
    simulation: Simulation, calibration: StereoCalibration, x_camera: FloatArray, row: Motion
) -> tuple[FloatArray, FloatArray]:
    """Return a point's apparent position in each eye (eyes, 3) and its triangulated position (3,) [m].

    A shift of the triangulated position beyond the lenses moves the images accordingly. A longer focal length makes the
    image larger, so the point appears nearer.
    """
    optics = simulation.optics
    eyes = calibration.eyes_m
    rays = np.concatenate(optics.rays(x_camera[None], calibration))[: len(eyes)]
    by_lenses = optics.reported(x_camera[None], calibration)
    seen = (simulation.altered(by_lenses, row) + simulation.added(row))[0]
    before, after = by_lenses[0] - eyes, seen - eyes
    rays += after[:, :2] / after[:, 2:] - before[:, :2] / before[:, 2:]
    x_eyes = np.column_stack([rays, np.ones(len(eyes))]) * (x_camera[2] / (1.0 + optics.focal_error))
    return x_eyes, seen
