"""The robot.toml that `bodyschema config init` writes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from interfaces.urdf import UrdfTree


class Guess(NamedTuple):
    """What a URDF lets one guess; the user corrects it."""

    name: str
    urdf: str
    joints: list[str]
    marker_link: str
    camera_link: str


EXAMPLE = Guess("my_robot", "my_robot.urdf", ["joint_1", "joint_2"], "hand", "base_link")

_TEMPLATE = """\
# A robot for bodyschema. Mend what is marked CHECK, then type `bodyschema config check`.

[robot]
# Part of the zenoh keys: letters, digits, _ . -
name = {name}
# Relative to this file.
urdf = {urdf}
# CHECK: the joints between camera and marker that are read and learnt, in the order from the camera to the marker.
joints = {joints}
# CHECK: the link that carries the marker, and the marker's centre in it [m].
marker_link = {marker_link}
marker_xyz = [0.0, 0.0, 0.0]
# true once marker_xyz was measured; false fits it first.
marker_known = false
# Who bears the arm's weight: torque_free | zero_force | held
hold = "torque_free"

# The measurement frame: the left optical frame, x right, y down, z forward.
[camera]
# CHECK: the link the cameras stand on, or ride on (a head).
parent_link = {camera_link}
# CHECK: pose of the left optical frame in it [m, rad], as in URDF; this rpy looks along the link's x axis.
xyz = [0.0, 0.0, 0.0]
rpy = [-1.5707963267948966, 0.0, -1.5707963267948966]
# true once the pose was measured; false fits it first.
pose_known = false
# The rectified stereo pair, from its calibration; all or none.
# focal_px = 600.0
# principal_point_px = [319.5, 239.5]
# baseline_m = 0.09
# image_size_px = [640, 480]

# Where the two processes listen; this machine only, unless you say otherwise.
[zenoh]
sampler = "tcp/127.0.0.1:7447"
learner = "tcp/127.0.0.1:7448"

[daemon]
# Store and checkpoint; else $XDG_STATE_HOME/bodyschema/<name>.
# state_dir = "state"
# Neighbouring pairs are this far apart in joint space; farther starts a new segment.
min_step_deg = 1.0
max_step_deg = 3.0

[drivers]
# Played in the place of encoders and camera; or start with --sim.
# recording = "recording.csv"

[vision]
# red, orange, yellow, green, cyan, blue, magenta, or a band of hues as the table [vision.colour].
colour = "red"
# Of the marker ball [m].
radius_m = 0.020
"""


def robot_toml(guess: Guess) -> str:
    """The text of a commented robot.toml."""
    joints = "[" + ", ".join(_quoted(joint) for joint in guess.joints) + "]"
    return _TEMPLATE.format(
        name=_quoted(guess.name),
        urdf=_quoted(guess.urdf),
        joints=joints,
        marker_link=_quoted(guess.marker_link),
        camera_link=_quoted(guess.camera_link),
    )


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def guess_from(urdf: Path, robot: Path) -> Guess:
    """The longest chain of moving joints of `urdf`, from its root to the last link that is fixed to its end.

    Args:
        robot: the robot.toml to be written; the URDF is named relative to it.

    Raises:
        RobotError: the URDF cannot be read.
    """
    from interfaces.urdf import MOVING, UrdfTree

    tree = UrdfTree.load(urdf)
    root = _root(tree)
    paths = {link: [joint for joint, _ in tree.path(root, link)] for link in tree.links}
    moving = {link: [joint.name for joint in path if joint.kind in MOVING] for link, path in paths.items()}
    end = max(tree.links, key=lambda link: (len(moving[link]), len(paths[link])))
    name = "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "_" for c in tree.name).lstrip(".-") or "robot"
    return Guess(name, os.path.relpath(urdf, robot.parent), moving[end], end, root)


def _root(tree: UrdfTree) -> str:
    children = {joint.child for joint in tree.joints.values()}
    return next(link for link in tree.links if link not in children)
