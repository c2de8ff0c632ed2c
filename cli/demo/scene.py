"""The demo's folder: a robot.toml with free ports, the robot's URDF, and the results."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from bodyschema.cli.replay.processes import free_endpoint
from bodyschema.daemon.wiring.wiring import demonstration_model
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.whole_files import raising_write_errors
from bodyschema.robot.description import RobotDescription

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation  # it takes half a second to import, and a ball has no rotation


class _Settings:
    # Side of the cube [m], and of its black squares as a fraction: the white margin of a tag is an eighth of its side.
    cube_m, square = 0.07, 0.8
    # Side of a single tag's black square, and its distance in front of the tool's centre line [m], clear of the stick.
    tag_m, before_m = 0.06, 0.007


FORWARD = np.array([1.0, 0.0, 0.0])


def tag_tables(towards_hand: FloatArray) -> str:
    """Return the tables [vision] for one tag along the tool's end, facing forward when the arm hangs.

    The tool is behind the tag; in front it would cover it.

    Args:
        towards_hand: direction of the tool from the marker (3,), in the marker's frame, any length, not forward.
    """
    from scipy.spatial.transform import Rotation

    up = towards_hand / np.linalg.norm(towards_hand)
    ahead = FORWARD - (FORWARD @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    rpy = Rotation.from_matrix(np.column_stack([np.cross(up, ahead), up, ahead])).as_euler("xyz")
    return "\n".join([*_head(_Settings.tag_m), *_tag(0, _Settings.before_m * ahead, rpy)]) + "\n"


def cube_tables(towards_hand: FloatArray) -> str:
    """Return the tables [vision] for a cube that stands on one of its corners, with six tags.

    The tool ends in that corner and covers no face, so that three faces point back to the hand.

    Args:
        towards_hand: direction of the tool from the marker (3,), in the marker's frame, any length.
    """
    from scipy.spatial.transform import Rotation

    lines = _head(_Settings.square * _Settings.cube_m)
    on_corner = Rotation.align_vectors(towards_hand[None] / np.linalg.norm(towards_hand), np.ones((1, 3)) / np.sqrt(3))[
        0
    ]
    for id, normal in enumerate(np.vstack([np.eye(3), -np.eye(3)])):
        face = on_corner * _outward(normal)
        lines += _tag(id, on_corner.apply(normal * _Settings.cube_m / 2), face.as_euler("xyz"))
    return "\n".join(lines) + "\n"


def _head(side_m: float) -> list[str]:
    return ["", "[vision]", 'marker = "cluster"', "", "[vision.tag]", f"side_m = {side_m:.6f}"]


def _tag(id: int, xyz: FloatArray, rpy: FloatArray) -> list[str]:
    return ["", "[[vision.cluster.tags]]", f"id = {id}", f"xyz = {_list(xyz)}", f"rpy = {_list(rpy)}"]


def _outward(normal: FloatArray) -> Rotation:
    """Return a rotation that maps z to `normal` (3,)."""
    from scipy.spatial.transform import Rotation

    side = np.roll(normal, 1)
    return Rotation.from_matrix(np.column_stack([side, np.cross(normal, side), normal]))


def _list(values: FloatArray) -> str:
    return "[" + ", ".join(f"{value:.9f}" for value in values) + "]"


STATE = "state"
# A folder with this file is a demo's, and may be emptied by the next one.
MARK = ".bodyschema-demo"
Bus = Literal["dynamixel", "feetech", "serial", "ros2"]
Marker = Literal["ball", "tag", "cluster"]
Camera = Literal["stereo", "mono"]
# Light ones in the neck, strong ones in the shoulder.
DYNAMIXEL = {
    "neck_yaw": "XL330-M288",
    "neck_pitch": "XL330-M288",
    "shoulder_flexion": "XM540-W270",
    "shoulder_abduction": "XM540-W270",
    "upperarm_rotation": "XM430-W350",
    "elbow_flexion": "XM430-W350",
    "forearm_rotation": "XM430-W350",
}
FEETECH = {joint: "STS3250" if joint.startswith("shoulder") else "STS3215" for joint in DYNAMIXEL}


class Scene:
    """Paths of the files of one demo."""

    def __init__(self, folder: Path) -> None:
        self.robot_file = folder / "robot.toml"  # the robot's description with the demo's ports and seed
        self.log_file = folder / "daemon.log"  # of the two processes
        self.store_file = folder / STATE / "pairs.sqlite"
        self.recording_file = folder / "recording.csv"  # all accepted pairs
        self.first_tool_file = folder / "first_tool.csv"  # the pairs of the first tool, which one model can explain
        self.curve_file, self.plot_file = folder / "learning_curve.csv", folder / "learning_curve.svg"


def prepare(
    folder: Path, seed: int, *, bus: Bus | None = None, marker: Marker = "ball", camera: Camera = "stereo"
) -> Scene:
    """Lay out the demo's folder; files of an earlier demo are replaced.

    Args:
        bus: emulated bus that the joints are read through.
        camera: the stereo pair, or its left eye alone.

    Raises:
        ConfigError: the folder is neither empty nor a demo's, or cannot be written.
    """
    model = demonstration_model()
    with raising_write_errors(folder, remedy="Give another --out or free some space"):
        folder.mkdir(parents=True, exist_ok=True)
        found = sorted(path.name for path in folder.iterdir())
        if found and MARK not in found:
            raise ConfigError(f"holds {found[0]!r}, and no demo was here", file=folder, remedy="Give another --out")
        for path in list(folder.iterdir()):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        (folder / MARK).touch()
        for path in model.parent.iterdir():
            if path.suffix in {".urdf", ".toml"}:
                shutil.copyfile(path, folder / path.name)
        scene = Scene(folder.resolve())
        described = model.read_text(encoding="utf-8")
        if camera == "mono":
            described = re.sub(r"(?m)^baseline_m = .*$", "eyes = 1", described)
        scene.robot_file.write_text(described + _own_tables(seed, bus) + _marker(marker, model), encoding="utf-8")
    return scene


def _own_tables(seed: int, bus: Bus | None) -> str:
    emulator = "" if bus is None else f"servo_bench = true\n{_joints(bus)}"
    return f"""
[zenoh]
sampler = "{free_endpoint()}"
learner = "{free_endpoint()}"

[daemon]
state_dir = "{STATE}"

[sim]
seed = {seed}
{emulator}"""


def _marker(marker: Marker, model: Path) -> str:
    """Return the [vision] tables for the marker in the hand."""
    towards_hand = -np.array(RobotDescription.load(model).robot.marker_xyz)
    match marker:
        case "ball":
            return "\n[vision]\nradius_m = 0.02\n"  # of the simulation's ball
        case "tag":
            return tag_tables(towards_hand)
        case "cluster":
            return cube_tables(towards_hand)


def _joints(bus: Bus) -> str:
    """Return the [drivers] tables for the arm's joints on this kind of bus."""
    match bus:
        case "dynamixel":
            return _servos("dynamixel", DYNAMIXEL)
        case "feetech":
            return _servos("feetech", FEETECH)
        case "serial":
            encoders = (f'[[drivers.serial_lines.encoders]]\njoint = "{joint}"\n' for joint in DYNAMIXEL)
            return "\n".join(["", "[drivers.serial_lines]", 'port = "bus"', "", *encoders])
        case "ros2":
            return "\n[drivers.ros2]\n"


def _servos(make: str, models: Mapping[str, str]) -> str:
    lines = ["", f"[drivers.{make}.buses.arm]", 'port = "bus"']
    for id, (joint, model) in enumerate(models.items(), 1):
        lines += ["", f"[[drivers.{make}.servos]]", f'joint = "{joint}"', f"id = {id}", f'model = "{model}"']
    return "\n".join(lines) + "\n"
