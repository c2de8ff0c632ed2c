"""A humanoid arm seen by cameras on its own head, and a hand-guided path of it, for several benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from kbmaps import RigidChain
from kbmaps.arrays import FloatArray

ARM_JOINTS = 5
NECK_JOINTS = 2
JOINTS = NECK_JOINTS + ARM_JOINTS
WAYPOINT_DEG = 45.0


def nominal_chain() -> RigidChain:
    """Return the nominal chain: camera on the head, two neck joints, five arm joints; lengths near ARMAR-III's [m].

    The measurement frame is the camera's. The camera is 80 mm in front of and 320 mm above the shoulder line. Upper arm
    310 mm, forearm 240 mm, hand with tool 220 mm; the elbow is bent by 60 degrees at zero.
    """
    x, y, z = np.eye(3)
    # Axes from camera to marker: neck tilt, neck pan, shoulder yaw, pitch, roll, elbow, forearm roll.
    axes = np.array([y, z, z, y, x, y, x])
    shifts = [(-0.08, 0.0, -0.12), (0, 0, 0), (0, -0.2, -0.20), (0, 0, 0), (0, 0, 0), (0.31, 0, 0), (0.24, 0, 0)]
    fixed = np.tile(np.eye(4), (JOINTS + 1, 1, 1))
    for k, shift in enumerate(shifts):
        fixed[k, :3, 3] = shift
    fixed[5, :3, :3] = Rotation.from_rotvec(np.radians(-60.0) * y).as_matrix()
    fixed[JOINTS, :3, 3] = (0.19, 0.03, 0.11)
    return RigidChain(fixed, axes, np.zeros(JOINTS, dtype=np.bool_))


def built_chain(
    nominal: RigidChain,
    rng: np.random.Generator,
    *,
    axis_deg: float = 2.0,
    shift_mm: float = 10.0,
    tool_mm: float = 30.0,
) -> RigidChain:
    """Return a random true arm: every link of the nominal one rotated and shifted a little, and the marker moved.

    `axis_deg` and `shift_mm` are standard deviations of each component, `tool_mm` that of the marker's shift.
    """
    fixed = nominal.fixed.copy()
    for transform in fixed:
        turn = Rotation.from_rotvec(np.radians(axis_deg) * rng.normal(size=3)).as_matrix()
        transform[:3, :3] = transform[:3, :3] @ turn
        transform[:3, 3] += 1e-3 * shift_mm * rng.normal(size=3)
    return RigidChain(fixed, nominal.axes, nominal.prismatic).with_tool(1e-3 * tool_mm * rng.normal(size=3))


@dataclass(frozen=True)
class GuidedPath:
    """Joint angles (n, 7) [rad] in steps of 1..3 degrees (norm over all joints) along one smooth path."""

    q: FloatArray


def guided_path(pairs: int, rng: np.random.Generator, waypoint_deg: float = WAYPOINT_DEG) -> GuidedPath:
    """Return a smooth path of the arm through random waypoints; the neck follows the arm with a gain and a lag."""
    # Waypoints are some 80 degrees apart in the joint space, a step covers 2: a quarter more than needed.
    waypoints = np.radians(rng.uniform(-waypoint_deg, waypoint_deg, (8 + pairs // 30, ARM_JOINTS)))
    spline = CubicSpline(np.arange(len(waypoints)), waypoints)
    arm = spline(np.linspace(0, len(waypoints) - 1, 400 * len(waypoints)))
    gaze = arm[:, :NECK_JOINTS] @ np.array([[0.3, 0.5], [0.5, -0.2]])
    lag = np.exp(-np.arange(400) / 100.0)
    neck = np.stack([np.convolve(g, lag / lag.sum())[: len(g)] for g in gaze.T], axis=1)
    dense = np.concatenate([neck, arm], axis=1)[400:]
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    stops = np.cumsum(np.radians(rng.uniform(1.0, 3.0, pairs)))
    if stops[-1] > travelled[-1]:
        raise ValueError(f"the path of {np.degrees(travelled[-1]):.0f} deg is too short for {pairs} pairs")
    return GuidedPath(np.stack([np.interp(stops, travelled, joint) for joint in dense.T], axis=1))
