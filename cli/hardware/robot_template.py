"""The robot.toml that `bodyschema init` writes."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.suggest import did_you_mean
from bodyschema.robot.toml_text import toml_value
from bodyschema.robot.urdf import MOVING, UrdfJoint, UrdfTree


class Guess(NamedTuple):
    """Description of a robot guessed from its URDF, for the user to correct."""

    name: str
    urdf: str
    joints: list[str]
    marker_link: str
    camera_link: str


class CameraFindings(NamedTuple):
    """Cameras of the robot and their marker."""

    cameras: Sequence[str] = ()  # those that are plugged in; with two or more, the first two are the eyes
    webcam: str | None = None  # one camera alone, in their place
    tag_mm: float | None = None  # side of the tag; ball_mm: diameter of the ball. Without any marker a ball of 40 mm.
    ball_mm: float | None = None
    chessboard: tuple[int, int, float] | None = None  # columns and rows of squares, and the side of a square [mm]

    def marker(self) -> str:
        """Return the marker's keys and tables."""
        if self.chessboard is not None:
            columns, rows, square_mm = self.chessboard
            return _CHESSBOARD.format(columns=columns, rows=rows, square_m=_metres(square_mm))
        if self.tag_mm is not None:
            return _TAG.format(side_m=_metres(self.tag_mm))
        return _BALL.format(radius_m=_metres((self.ball_mm or 40.0) / 2))


_NOTHING_SEEN = CameraFindings()
_FINGER = re.compile(r"gripper|finger|jaw|knuckle", re.IGNORECASE)
EXAMPLE = Guess("my_robot", "my_robot.urdf", ["joint_1", "joint_2"], "hand", "base_link")

_TEMPLATE = """\
# A robot for bodyschema. Fix what is marked CHECK, then type `bodyschema config`.

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
# CHECK: who bears the arm's weight while it is recorded: torque_free (a guiding hand) | zero_force | held (its motors).
hold = "torque_free"

# The measurement frame: the {frame}, x right, y down, z forward.
[camera]
# CHECK: the link the cameras stand on, or ride on (a head).
parent_link = {camera_link}
# CHECK: pose of the {frame} in it [m, rad], as in URDF; this rpy looks along the link's x axis.
xyz = [0.0, 0.0, 0.0]
rpy = [-1.5707963267948966, 0.0, -1.5707963267948966]
# true once the pose was measured; false fits it first.
pose_known = false
{eyes}
# Where the two processes listen; this machine only, unless you say otherwise.
[zenoh]
sampler = "tcp/127.0.0.1:7447"
learner = "tcp/127.0.0.1:7448"

[daemon]
# Store and checkpoint; else $XDG_STATE_HOME/bodyschema/<name>.
# state_dir = "state"
# Neighbouring samples are this far apart in joint space; farther starts a new segment.
min_step_deg = 1.0
max_step_deg = 3.0

[drivers]
# Played in the place of encoders and camera; or start with --sim.
# recording = "recording.csv"

[vision]
{marker}
# Another program that measures the marker, in the place of cameras: udp, natnet, zenoh or ros2. docs/marker_sources.md
# [marker_source]
# kind = "udp"
# port = 5005
# sigma_m = 0.001

# CHECK: the cameras; `bodyschema scan` names those that are plugged in, docs/cameras.md has the rest.
{cameras}"""

_TWO_EYES = """\
# The rectified stereo pair, from its calibration; all or none. One camera alone: eyes = 1, and no baseline_m.
# focal_px = 600.0
# principal_point_px = [319.5, 239.5]
# baseline_m = 0.09
# image_size_px = [640, 480]
"""
_ONE_EYE = """\
# One camera alone: depth comes from the size of the marker.
eyes = 1
"""
_BALL = """\
# red, orange, yellow, green, cyan, blue, magenta, or a band of hues as the table [vision.colour].
colour = "red"
# Of the marker ball [m].
radius_m = {radius_m}
"""
_TAG = """\
marker = "tag"

[vision.tag]
# Its number, and the side of its black square as measured [m].
id = 0
side_m = {side_m}
"""
_CHESSBOARD = """\
marker = "chessboard"

[vision.chessboard]
# Its squares, one number even and one odd, and the side of a square as measured across all of them [m].
columns = {columns}
rows = {rows}
square_m = {square_m}
"""
_CAMERAS = """\
[vision.cameras]
{hidden}calibration = "cameras.toml"   # as `bodyschema calibrate cameras` writes it; else images are rectified
# latency_s = 0.0                # as `bodyschema calibrate latency` says, with its latency_sigma_s
# readout_s = 0.02               # from the first to the last row, 0 for a global shutter; else moving tags are unsure
{devices}image_size_px = [640, 480]
fps = 30.0
# exposure_s = 0.005             # a short one: a moving ball blurs. Without a value the camera chooses.
# gain = 64
# white_balance_k = 4600
# focus = 0
"""
_TWO = """\
# One camera alone is the table [vision.cameras.one] with device in the place of left and right: docs/one_camera.md.
[vision.cameras.two]
left = {left}
right = {right}
"""
_ONE = """\

[vision.cameras.one]
device = {device}
"""
_EXAMPLES = "/dev/v4l/by-id/usb-LEFT-video-index0", "/dev/v4l/by-id/usb-RIGHT-video-index0"


def robot_toml(guess: Guess, seen: CameraFindings = _NOTHING_SEEN) -> str:
    """Return the text of a commented robot.toml."""
    return _TEMPLATE.format(
        name=toml_value(guess.name),
        urdf=toml_value(guess.urdf),
        joints=toml_value(guess.joints),
        marker_link=toml_value(guess.marker_link),
        camera_link=toml_value(guess.camera_link),
        frame="left optical frame" if seen.webcam is None else "camera's optical frame",
        eyes=_TWO_EYES if seen.webcam is None else _ONE_EYE,
        marker=seen.marker(),
        cameras=_camera_tables(seen),
    )


def _metres(length_mm: float) -> str:
    return f"{1e-3 * length_mm:.6g}"


def _camera_tables(seen: CameraFindings) -> str:
    """Return the cameras' tables; with fewer than two cameras, an example that is commented out."""
    if seen.webcam is not None:
        return _CAMERAS.format(hidden="", devices=_ONE.format(device=toml_value(seen.webcam)))
    left, right = map(toml_value, seen.cameras[:2] if len(seen.cameras) >= 2 else _EXAMPLES)
    text = _CAMERAS.format(hidden="# ", devices=_TWO.format(left=left, right=right))
    if len(seen.cameras) >= 2:
        return text
    return "".join(line if line.startswith("#") else f"# {line}" for line in text.splitlines(keepends=True))


def guess_from(urdf: Path, robot: Path, marker_link: str | None, camera_link: str | None) -> Guess:
    """Guess the chain with the most moving joints in `urdf`, without fingers and joints that mimic others.

    Args:
        robot: path of the robot.toml to be written; the URDF is named relative to it.
        marker_link: the link with the marker; by default the last link fixed to the end of the chain.
        camera_link: the link of the cameras; by default the root.

    Raises:
        RobotError: the URDF cannot be read.
        ConfigError: it has no such link, or no joint moves between the two.
    """
    tree = UrdfTree.load(urdf)
    for link in (marker_link, camera_link):
        if link is not None and link not in tree.links:
            raise ConfigError(f"has no link {link!r}", file=urdf, remedy=did_you_mean(link, tree.links))
    if marker_link is None:
        root = camera_link or tree.root
        paths = {link: [joint for joint, _ in tree.path(root, link)] for link in tree.links}
        whole = {link: path for link, path in paths.items() if not any(map(_is_finger, path))}
        marker_link = max(whole, key=lambda link: (len(_moving(whole[link])), len(whole[link])))
    guess = guess_of(tree, os.path.relpath(urdf, robot.parent), marker_link, camera_link)
    if not guess.joints:
        between = f"between {guess.camera_link} and {guess.marker_link} no joint moves"
        raise ConfigError(between, file=urdf, remedy="Is it the URDF of the arm, and are these its links?")
    return guess


def guess_of(tree: UrdfTree, urdf: str, end: str, root: str | None = None) -> Guess:
    """Return the chain of moving joints from a link of `tree`, by default its root, to the link `end`."""
    root = root or tree.root
    joints = _moving([joint for joint, _ in tree.path(root, end)])
    return Guess(key_name(tree.name), urdf, joints, end, root)


def _moving(path: Sequence[UrdfJoint]) -> list[str]:
    return [joint.name for joint in path if joint.kind in MOVING]


def _is_finger(joint: UrdfJoint) -> bool:
    """Return True for a joint that mimics another one, or belongs to a gripper by its name."""
    return joint.mimics or (joint.kind in MOVING and bool(_FINGER.search(joint.name)))


def key_name(text: str) -> str:
    """Return `text` as a robot's name, which is part of the zenoh keys."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "_" for c in text).lstrip(".-") or "robot"
