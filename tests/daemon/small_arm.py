"""A robot of two joints in two files."""

from __future__ import annotations

from pathlib import Path

JOINTS = ("waist", "shoulder")
URDF = """<robot name="arm"><link name="base"/><link name="upper"/><link name="hand"/>
<joint name="waist" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="shoulder" type="revolute"><parent link="upper"/><child link="hand"/><origin xyz="0.3 0 0"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""
ROBOT = """[robot]
name = "arm"
urdf = "arm.urdf"
joints = ["waist", "shoulder"]
marker_link = "hand"
[camera]
parent_link = "base"
"""


def write_small_arm(folder: Path, tables: str = "") -> Path:
    """Write robot.toml, with `tables` appended, and its URDF into `folder`; the path of robot.toml."""
    (folder / "arm.urdf").write_text(URDF)
    file = folder / "robot.toml"
    file.write_text(ROBOT + tables)
    return file


def write_long_arm(folder: Path, joints: int) -> Path:
    """Write robot.toml and URDF of an arm of revolute joints into `folder`; return the path of robot.toml."""
    links = "".join(f'<link name="link_{k}"/>' for k in range(joints + 1))
    turning = "".join(
        f'<joint name="joint_{k}" type="revolute"><parent link="link_{k}"/><child link="link_{k + 1}"/>'
        f'<origin xyz="0.1 0 0.02"/><axis xyz="{k % 2} 0 {1 - k % 2}"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        for k in range(joints)
    )
    (folder / "long.urdf").write_text(f'<robot name="long">{links}{turning}</robot>')
    names = [f"joint_{k}" for k in range(joints)]
    file = folder / "robot.toml"
    file.write_text(
        f'[robot]\nname = "long"\nurdf = "long.urdf"\njoints = {names}\nmarker_link = "link_{joints}"\n'
        '[camera]\nparent_link = "link_0"\n'
    )
    return file
