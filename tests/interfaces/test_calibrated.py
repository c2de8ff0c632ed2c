"""A calibrated chain written as URDF and robot.toml gives the same positions in every reader."""

from __future__ import annotations

import tempfile
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_robots import random_robot
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.calibrated import CalibratedGeometry
from bodyschema.robot.calibrated_files import CAMERA_LINK, MARKER_LINK, write_calibrated
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.rpy import rpy_of
from bodyschema.robot.toml_file import read_toml
from bodyschema.robot.toml_text import toml_text
from kbmaps import ChainParameters, RigidChain

CLOSE_M = 1e-9
HEADS = st.text("RPFH", max_size=3)
ARMS = st.text("RPFH", max_size=4).map(lambda kinds: kinds + "R")


def learnt(robot: RobotDescription, rng: np.random.Generator) -> tuple[RigidChain, CalibratedGeometry]:
    """Return a chain some degrees and centimetres off nominal, a camera far off, and the files' terms for it."""
    parameters = ChainParameters(robot.chain)
    change = 0.05 * rng.normal(size=parameters.size)
    change[parameters.base_turn] = rng.uniform(-1.5, 1.5, 3)
    chain, zeros = parameters.chain(change), change[parameters.zeros]
    pose = parameters.base_pose(change)
    return chain, CalibratedGeometry.of(robot, chain, T_measured_nominal=pose, zeros=zeros)


def written(folder: Path, seed: int, head: str, arm: str) -> tuple[RobotDescription, RigidChain, Path]:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, folder, head=head, arm=arm)
    chain, geometry = learnt(robot, rng)
    return robot, chain, write_calibrated(robot, geometry, folder / "out", "From a test")


def some_q(robot: RobotDescription) -> np.ndarray:
    return np.random.default_rng(7).uniform(-2.0, 2.0, (20, len(robot.joints)))


# --- the same positions


@given(st.integers(0, 10**6), HEADS, ARMS)
def test_our_own_loader_reads_the_learnt_positions(seed, head, arm) -> None:
    with tempfile.TemporaryDirectory() as folder:
        robot, chain, file = written(Path(folder), seed, head, arm)
        read = RobotDescription.load(file)
    assert read.joints == robot.joints
    q = some_q(robot)
    np.testing.assert_allclose(read.chain.positions(q), chain.positions(q), rtol=0, atol=CLOSE_M)


@given(st.integers(0, 10**6), HEADS, ARMS)
def test_pybullet_reads_the_learnt_positions(seed, head, arm) -> None:
    pybullet = pytest.importorskip("pybullet")
    with tempfile.TemporaryDirectory() as folder:
        robot, chain, file = written(Path(folder), seed, head, arm)
        urdf = without_visuals(file.parent / "robot.urdf")
        client = pybullet.connect(pybullet.DIRECT)
        try:
            body = pybullet.loadURDF(str(urdf), useFixedBase=True, physicsClientId=client)
            x = [bullet_position(pybullet, client, body, robot, q) for q in some_q(robot)]
        finally:
            pybullet.disconnect(client)
    np.testing.assert_allclose(x, chain.positions(some_q(robot)), rtol=0, atol=CLOSE_M)


def without_visuals(urdf: Path) -> Path:
    """Return a URDF without visuals: pybullet loads no URDF whose meshes are missing."""
    tree = ElementTree.parse(urdf)
    for link in tree.iterfind("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    plain = urdf.with_name("plain.urdf")
    tree.write(plain)
    return plain


def bullet_position(pybullet, client: int, body: int, robot: RobotDescription, q: np.ndarray) -> np.ndarray:
    """Return the marker in the camera's frame (3,) computed by pybullet.

    It hands out frames of links in single precision and centres of mass in double; in these two links they coincide.
    """
    values = dict(zip(robot.joints, q, strict=True)) | robot.robot.held_at
    links = {}
    for k in range(pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getJointInfo(body, k, physicsClientId=client)
        links[info[12].decode()] = k
        if info[1].decode() in values:
            pybullet.resetJointState(body, k, values[info[1].decode()], physicsClientId=client)
    (x_camera, turn), (x_marker, _) = (
        pybullet.getLinkState(body, links[name], computeForwardKinematics=True, physicsClientId=client)[:2]
        for name in (CAMERA_LINK, MARKER_LINK)
    )
    return Rotation.from_quat(turn).inv().apply(np.subtract(x_marker, x_camera))


@given(st.integers(0, 10**6), HEADS, ARMS)
def test_pinocchio_reads_the_learnt_positions(seed, head, arm) -> None:
    pinocchio = pytest.importorskip("pinocchio")
    with tempfile.TemporaryDirectory() as folder:
        robot, chain, file = written(Path(folder), seed, head, arm)
        model = pinocchio.buildModelFromUrdf(str(file.parent / "robot.urdf"))
    data, held = model.createData(), robot.robot.held_at
    frames = [model.getFrameId(CAMERA_LINK), model.getFrameId(MARKER_LINK)]
    x = []
    for q in some_q(robot):
        values = dict(zip(robot.joints, q, strict=True)) | held
        pinocchio.framesForwardKinematics(model, data, np.array([values.get(n, 0.0) for n in list(model.names)[1:]]))
        camera, marker = (data.oMf[frame] for frame in frames)
        x.append(camera.actInv(marker).translation)
    np.testing.assert_allclose(x, chain.positions(some_q(robot)), rtol=0, atol=CLOSE_M)


def test_recalibration_replaces_the_earlier_calibration_frames(tmp_path) -> None:
    _, _, file = written(tmp_path, 3, "R", "RFR")
    robot = RobotDescription.load(file)
    chain, geometry = learnt(robot, np.random.default_rng(4))
    again = RobotDescription.load(write_calibrated(robot, geometry, tmp_path / "again", "Once more"))
    np.testing.assert_allclose(again.chain.positions(some_q(robot)), chain.positions(some_q(robot)), atol=CLOSE_M)
    assert again.tree.links.count(CAMERA_LINK) == 1


# --- other contents of the files


@pytest.fixture
def before_and_after(tmp_path) -> tuple[ElementTree.Element, ElementTree.Element]:
    written(tmp_path, 1, "RF", "RFHPR")
    return tuple(ElementTree.parse(tmp_path / name).getroot() for name in ("robot.urdf", "out/robot.urdf"))


def test_urdf_keeps_masses_and_limits_adding_two_links(before_and_after) -> None:
    before, after = before_and_after
    for tag in ("inertial", "limit"):
        texts = [[ElementTree.tostring(element) for element in root.iter(tag)] for root in before_and_after]
        assert [text for text in texts[0] if text not in texts[1]] == []
    assert len(list(after.iter("link"))) == len(list(before.iter("link"))) + 2


def test_axes_stay_but_are_of_unit_length(before_and_after) -> None:
    axes = [
        np.array([element.attrib["xyz"].split() for element in root.iter("axis")], dtype=float)
        for root in before_and_after
    ]
    np.testing.assert_allclose(axes[1], axes[0] / np.linalg.norm(axes[0], axis=1, keepdims=True), rtol=0, atol=1e-15)


def test_only_learnt_joints_get_another_origin(before_and_after) -> None:
    before, after = before_and_after
    assert changed_origins(before, after) == {"head_1", "arm_0", "arm_3", "arm_4"}


def changed_origins(before: ElementTree.Element, after: ElementTree.Element) -> set[str]:
    def origins(root: ElementTree.Element) -> dict[str, dict[str, str]]:
        found = {joint.attrib["name"]: joint.find("origin") for joint in root.iterfind("joint")}
        return {name: {} if origin is None else origin.attrib for name, origin in found.items()}

    return {name for name, origin in origins(before).items() if origins(after)[name] != origin}


def test_a_mesh_is_found_where_it_was(tmp_path) -> None:
    written(tmp_path, 1, "", "RR")
    names = {mesh.attrib["filename"] for mesh in ElementTree.parse(tmp_path / "out/robot.urdf").iter("mesh")}
    assert "../meshes/base.stl" in names


def test_comments_stay(tmp_path) -> None:
    written(tmp_path, 1, "", "RR")
    text = (tmp_path / "out/robot.urdf").read_text()
    assert ("<!-- From a test -->" in text, "<!-- kept -->" in text) == (True, True)


def test_robot_toml_keeps_other_tables_and_recording_path(tmp_path) -> None:
    _, _, file = written(tmp_path, 1, "", "RR")
    before, after = read_toml(tmp_path / "robot.toml")[0], read_toml(file)[0]
    assert after["sim"] == before["sim"]
    assert (file.parent / after["drivers"]["recording"]).resolve() == tmp_path / "pairs.csv"


def test_calibrated_robot_has_its_own_state_directory(tmp_path) -> None:
    _, _, file = written(tmp_path, 1, "", "RR")
    assert (file.parent / read_toml(file)[0]["daemon"]["state_dir"]).resolve() == tmp_path / "out" / "state"


def test_calibrated_camera_and_marker_are_marked_known(tmp_path) -> None:
    robot = RobotDescription.load(written(tmp_path, 1, "", "RR")[2])
    assert (robot.camera.pose_known, robot.robot.marker_known) == (True, True)


def test_nothing_is_replaced(tmp_path) -> None:
    written(tmp_path, 1, "", "RR")
    with pytest.raises(ConfigError, match=r"robot.urdf: is there already. Give another folder"):
        written(tmp_path, 1, "", "RR")


def test_uncreatable_folder_is_reported(tmp_path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(ConfigError, match=r"out: cannot be written: File exists. Give another folder"):
        written(tmp_path, 1, "", "RR")


# --- meshes stay on the parts that they show


@given(st.integers(0, 10**6), st.text("RP", max_size=2), st.text("RP", min_size=1, max_size=4))
def test_joint_offset_turns_only_the_joint_s_link(seed, head, arm) -> None:
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        robot = random_robot(rng, Path(folder), head=head, arm=arm)
    parameters = ChainParameters(robot.chain)
    change = np.zeros(parameters.size)
    joint = int(rng.integers(parameters.reference.joints))
    change[parameters.zeros][joint] = 0.1
    geometry = CalibratedGeometry.of(
        robot, parameters.chain(change), T_measured_nominal=np.eye(4), zeros=change[parameters.zeros]
    )
    moved = [
        name
        for name, pose in geometry.T_parent_joint.items()
        if np.abs(pose - robot.tree.joint(name).T_parent_joint).max() > CLOSE_M
    ]
    assert moved == [robot.joints[joint]]
    np.testing.assert_allclose(geometry.T_parent_camera, robot.camera.pose, atol=CLOSE_M)
    np.testing.assert_allclose(geometry.marker_xyz, robot.robot.marker_xyz, atol=CLOSE_M)


# --- the texts


@given(st.tuples(*[st.floats(-3.1, 3.1)] * 3), st.sampled_from([None, np.pi / 2, -np.pi / 2]))
def test_roll_pitch_and_yaw_give_the_rotation_again(angles, pitch) -> None:
    roll, free, yaw = angles
    rotation = Rotation.from_euler("xyz", [roll, free if pitch is None else pitch, yaw]).as_matrix()
    again = Rotation.from_euler("xyz", rpy_of(rotation)).as_matrix()
    np.testing.assert_allclose(again, rotation, rtol=0, atol=1e-14)


KEYS = st.text(min_size=1, max_size=5)
PLAIN = st.one_of(st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), st.text(max_size=8))
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3))


@given(st.dictionaries(KEYS, VALUES, max_size=4))
def test_toml_text_reads_as_what_was_written(tables) -> None:
    assert tomllib.loads(toml_text(tables)) == tables
