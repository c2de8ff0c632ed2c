"""Arms of public URDFs, with masses and meshes, as measured robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bodyschema.effects import Motion
from bodyschema.robot.description import RobotDescription

# folder and file in pybullet_data, joints, marker link, camera's parent
ARMS = {
    "iiwa": ("kuka_iiwa/model.urdf", "lbr_iiwa_joint_{}", 7, "lbr_iiwa_link_7", "lbr_iiwa_link_0"),
    "panda": ("franka_panda/panda.urdf", "panda_joint{}", 7, "panda_hand", "panda_link0"),
    "xarm6": ("xarm/xarm6_robot.urdf", "joint{}", 6, "link6", "link_base"),
}
TOML = """[robot]
name = "{name}"
urdf = "{urdf}"
joints = [{joints}]
marker_link = "{marker_link}"
marker_xyz = [0.05, 0.02, 0.1]
hold = "held"
[camera]
parent_link = "{camera_link}"
xyz = [1.6, 0.3, 0.9]
rpy = [-2.1, 0.0, 1.4]
"""


def public_arm(name: str, folder: Path) -> RobotDescription:
    """Return one of `ARMS`, described in `folder`."""
    data = Path(pytest.importorskip("pybullet_data").getDataPath())
    urdf, joint, count, marker_link, camera_link = ARMS[name]
    joints = ", ".join(f'"{joint.format(k + 1)}"' for k in range(count))
    file = folder / "robot.toml"
    text = TOML.format(name=name, urdf=data / urdf, joints=joints, marker_link=marker_link, camera_link=camera_link)
    file.write_text(text)
    return RobotDescription.load(file)


def readings(robot: RobotDescription, rows: int, seed: int = 0) -> Motion:
    """Return rows in which every joint reverses now and then, inside two thirds of its range."""
    rng = np.random.default_rng(seed)
    middle, half = 0.5 * (robot.lower + robot.upper), 0.33 * np.minimum(robot.upper - robot.lower, 2.0 * np.pi)
    return Motion(middle + rng.uniform(-half, half, (rows, len(half))), None, np.zeros(rows, dtype=np.int64))
