from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bodyschema.interfaces.errors import ConfigError, RobotError
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.urdf import UrdfTree

URDF = """<robot name="arm">
  <link name="base"/><link name="upper"/><link name="hand"/><link name="tip"/>
  <joint name="waist" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="shoulder" type="continuous">
    <parent link="upper"/><child link="hand"/><origin xyz="0.3 0 0"/><axis xyz="0 2 0"/>
  </joint>
  <joint name="flange" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0.1 0 0"/></joint>
</robot>"""
ROBOT = """[robot]
name = "arm"
urdf = "arm.urdf"
joints = ["waist", "shoulder"]
marker_link = "tip"
[camera]
parent_link = "base"
"""


def load(folder: Path, robot: str = ROBOT, urdf: str | None = URDF) -> RobotDescription:
    if urdf is not None:
        (folder / "arm.urdf").write_text(urdf)
    (folder / "robot.toml").write_text(robot)
    return RobotDescription.load(folder / "robot.toml")


# --- valid files


def test_chain_runs_from_camera_to_marker(tmp_path) -> None:
    robot = load(tmp_path)
    assert robot.chain.positions(np.zeros(2)) == pytest.approx([0.4, 0.0, 0.1])
    assert robot.chain.positions(np.array([np.pi / 2, -np.pi / 2])) == pytest.approx([0.0, 0.3, 0.2])


def test_hand_mounted_camera_reverses_the_chain(tmp_path) -> None:
    robot = load(
        tmp_path, ROBOT.replace('parent_link = "base"', 'parent_link = "tip"').replace('"tip"\n[', '"base"\n[')
        .replace('["waist", "shoulder"]', '["shoulder", "waist"]')
    )  # fmt: skip
    assert robot.chain.positions(np.zeros(2)) == pytest.approx([-0.4, 0.0, -0.1])


def test_a_joint_without_limits_turns_all_the_way(tmp_path) -> None:
    robot = load(tmp_path)
    assert (robot.lower[0], robot.upper[1]) == (-3.0, np.pi)


def test_fixed_joint_uses_its_held_at_angle(tmp_path) -> None:
    held = ROBOT.replace('["waist", "shoulder"]', '["waist"]\nheld_at = {shoulder = -1.5707963267948966}')
    assert load(tmp_path, held).chain.positions(np.zeros(1)) == pytest.approx([0.3, 0.0, 0.2])


# --- names that are wrong, with the line of robot.toml


@pytest.mark.parametrize(
    ("right", "wrong", "line", "said"),
    [
        ('"base"\n', '"base"\nxyz = [0.0, nan, 0.0]\n', 8, "camera.xyz: not a finite number"),
        ('"base"\n', '"base"\nfocal_px = inf\n', 8, "camera.focal_px: not a finite number"),
        ('"waist", ', '"wiast", ', 4, "there is no joint 'wiast' in arm.urdf. Did you mean 'waist'?"),
        ('"waist", ', '"leg", ', 4, "there is no joint 'leg' in arm.urdf. Known are: waist, shoulder, flange"),
        ('"waist", ', '"flange", ', 4, "joint 'flange' is fixed. Take it out of joints"),
        ('"shoulder"]', '"waist"]', 4, "joints names a joint twice. Name each once"),
        ('["waist", "shoulder"]', '[\n  "waist",\n  "shoulderr"\n]', 6, "there is no joint 'shoulderr' in arm.urdf"),
        ('"waist", "shoulder"', '"shoulder", "waist"', 4, "Write joints = ['waist', 'shoulder']"),
        ('"waist", "shoulder"', "", 4, "robot.joints: expected `array` of length >= 1"),
        ('marker_link = "tip"', 'marker_link = "tipp"', 5, "there is no link 'tipp' in arm.urdf. Did you mean 'tip'?"),
        ('parent_link = "base"', 'parent_link = "bas"', 7, "there is no link 'bas' in arm.urdf. Did you mean 'base'?"),
        ('marker_link = "tip"', 'held_at = {neck = 1}\nmarker_link = "tip"', 5, "there is no joint 'neck'"),
        ('marker_link = "tip"', "", 1, "robot: object missing required field `marker_link`"),
        ('marker_link = "tip"', 'marker_lnk = "tip"', 5, "unknown key 'marker_lnk' in [robot]. Did you mean 'marker_l"),
        ('name = "arm"', 'name = "my arm"', 2, "robot.name: 'my arm' is no name for zenoh keys"),
        ("[camera]", "[camera]\nfocal_px = 700", 6, "the stereo camera is described in part: principal_point_px"),
    ],
)
def test_robot_toml_error_states_line_and_remedy(tmp_path, right, wrong, line, said) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(tmp_path, ROBOT.replace(right, wrong))
    assert str(refusal.value).startswith(f"{tmp_path / 'robot.toml'}, line {line}: ")
    assert said in str(refusal.value)


def test_joint_not_moving_marker_error_lists_valid_joints(tmp_path) -> None:
    with pytest.raises(
        RobotError, match=r"robot.toml, line 4: joint 'shoulder' does not move the marker.*between them are: waist\)"
    ):
        load(tmp_path, ROBOT.replace('"tip"', '"upper"'))


# --- an invalid robot.toml


def test_folder_given_as_robot_toml_is_rejected(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"a folder, not a file. Name the robot.toml in it"):
        RobotDescription.load(tmp_path)


def test_binary_robot_toml_is_rejected_with_its_line(tmp_path) -> None:
    (tmp_path / "robot.toml").write_bytes(b"[robot]\nname = \xff\xfe")
    with pytest.raises(ConfigError, match=r"robot.toml, line 2: the byte 0xff is not UTF-8 text"):
        RobotDescription.load(tmp_path / "robot.toml")


def test_a_byte_order_mark_is_no_mistake(tmp_path) -> None:
    assert load(tmp_path, "\ufeff" + ROBOT.replace("\n", "\r\n")).name == "arm"


# --- an invalid URDF


def test_missing_urdf_error_names_the_robot_toml_key(tmp_path) -> None:
    with pytest.raises(RobotError, match=r"arm.urdf: cannot read.*No such file.*by robot.urdf in robot.toml, line 3$"):
        load(tmp_path, urdf=None)


def test_folder_given_as_urdf_is_rejected(tmp_path) -> None:
    (tmp_path / "arm.urdf").mkdir()
    with pytest.raises(RobotError, match=r"cannot read the URDF: Is a directory.*by robot.urdf in robot.toml, line 3$"):
        load(tmp_path, urdf=None)


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("</robot>", "", ", line 11: not XML: Premature end of data in tag robot line 1"),
        ('<robot name="arm">', '<!DOCTYPE robot [<!ENTITY e "x">]><robot name="arm">', ", line 1: a URDF with a DOC"),
        (
            '<robot name="arm">',
            '<robot name="arm" xmlns:xacro="http://wiki.ros.org/xacro"><xacro:arg name="a" default="1"/>',
            "line 1: this is a xacro file, of which a URDF is made first. With ROS: `xacro arm.urdf > made.urdf`",
        ),
        ('<child link="upper"/>', '<child link="uper"/>', "joint 'waist' names the link 'uper', which is not there"),
        ('<child link="tip"/>', '<child link="upper"/>', "link 'upper' hangs on more than one joint"),
        ('<link name="tip"/>', '<link name="tip"/><link name="spare"/>', "do not form one tree (roots: base, spare)"),
        ('"shoulder"', '"waist"', ", line 7: two joints have the same name, 'waist'. Rename one of them"),
        ('"continuous"', '"floating"', "joint 'shoulder' is of the type 'floating'. Use revolute"),
        ('xyz="0 2 0"', 'xyz="0 0 0"', "the axis of joint 'shoulder' has no length"),
        ('xyz="0.3 0 0"', 'xyz="0.3 nan 0"', ", line 8: <origin xyz='0.3 nan 0'> of joint 'shoulder' is not 3 finite"),
        ('xyz="0.3 0 0"', 'xyz="0.3 x 0"', ", line 8: <origin xyz='0.3 x 0'> of joint 'shoulder' is not 3 finite"),
        ('xyz="0 2 0"', 'xyz="0 2 0 1"', ", line 8: <axis xyz='0 2 0 1'> of joint 'shoulder' is not 3 finite numbers"),
        ('upper="3"', 'upper="3 4"', ", line 5: <limit upper='3 4'> of joint 'waist' is not a finite number"),
        ('<parent link="base"/>', "", ", line 3: joint 'waist' names no parent link. Write <parent link=\"...\"/>"),
        ('<link name="base"/>', "<link/>", ", line 2: a <link> has no name"),
        ('name="tip"/>', 'name="hand"/>', ", line 2: two links have the same name, 'hand'"),
        ('upper="3"', 'upper="1e308"', ", line 5: <limit> of joint 'waist' lets it turn by 1e+308 rad. Give radians"),
        ('xyz="0.3 0 0"', 'xyz="0.3 0 0" rpy="0 1e9 0"', "of joint 'shoulder' is turned by 1e+09 rad. Give radians"),
        ('lower="-3"', 'lower="4"', "joint 'waist' has its lower limit above its upper one. Swap them"),
        ('<axis xyz="0 0 1"/>', '<mimic joint="shoulder"/>', "joint 'waist' mimics another joint. Replace it"),
    ],
)
def test_invalid_urdf_error_states_file_and_place(tmp_path, right, wrong, said) -> None:
    assert right in URDF
    with pytest.raises(RobotError) as refusal:
        load(tmp_path, urdf=URDF.replace(right, wrong))
    assert str(refusal.value).startswith(str(tmp_path / "arm.urdf"))
    assert said in str(refusal.value)


def test_empty_urdf_is_rejected(tmp_path) -> None:
    with pytest.raises(RobotError, match=r"arm.urdf.*: not XML"):
        load(tmp_path, urdf="")


def test_non_urdf_xml_error_names_its_root_element(tmp_path) -> None:
    (tmp_path / "a.sdf").write_text("<sdf><model/></sdf>")
    with pytest.raises(RobotError, match=r"line 1: the root element is <sdf>, not <robot>"):
        UrdfTree.load(tmp_path / "a.sdf")
