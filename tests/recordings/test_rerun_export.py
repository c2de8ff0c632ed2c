"""Recordings for the Rerun viewer, read back by its own tools."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_arm import JOINTS, write_small_arm

from bodyschema.cli.main import app
from bodyschema.cli.recordings.rerun_scene import scene_of
from bodyschema.effects import Motion, load_simulation
from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings import files as recordings
from bodyschema.recordings.recording import Recording
from bodyschema.recordings.rerun_export import runs
from bodyschema.robot.description import link_poses

CAMERA = """xyz = [1.2, 0.3, 0.5]
rpy = [-1.9, 0.1, 1.5]
pose_known = false
focal_px = 600.0
principal_point_px = [319.5, 239.5]
baseline_m = 0.2
image_size_px = [640, 480]
"""
BUMPED = """[[effects]]
effect = "joint_offset"
where = "shoulder"
offset_rad = 0.02
[[effects]]
effect = "camera_pose"
x_m = 0.0
y_m = 0.05
z_m = 0.0
rx_rad = 0.0
ry_rad = 0.1
rz_rad = 0.0
"""


@pytest.fixture
def recording() -> Recording:
    rng = np.random.default_rng(4)
    t = np.arange(6) / 10
    return Recording(
        JOINTS, rng.normal(size=(6, 2)), rng.normal(size=(6, 3)), t=t, segment=np.array([1, 1, 1, 2, 2, 3])
    )


def tool(*words: str) -> str:
    command = [sys.executable, "-m", "rerun_cli", "rrd", *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_rerun_cli_finds_every_exported_row(tmp_path: Path, recording: Recording) -> None:
    pytest.importorskip("rerun")
    file = tmp_path / "a.rrd"
    recordings.write(recording, file)
    tool("verify", str(file))
    shown = tool("print", "-v", str(file))
    for name in ("marker", "waist", "shoulder"):
        assert [line for line in shown.splitlines() if f"/{name} " in line and "with 6 rows" in line], shown


def test_each_segment_is_a_path_of_its_own(recording: Recording) -> None:
    assert [len(run) for run in runs(recording)] == [3, 2, 1]


def test_missing_rerun_extra_is_named_without_partial_file(tmp_path, recording, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(RecordingError, match=r"bodyschema\[rerun\]"):
        recordings.write(recording, tmp_path / "a.rrd")
    assert list(tmp_path.iterdir()) == []


def predicted_by_links(scene, q: np.ndarray) -> np.ndarray:
    poses = link_poses(scene.robot, q)
    seen = np.linalg.inv(poses[scene.robot.camera.parent_link] @ scene.robot.camera.pose)
    return (seen @ poses["hand"] @ [*scene.robot.robot.marker_xyz, 1.0])[:, :3]


@pytest.mark.parametrize("effects", ["", BUMPED])
def test_the_drawn_robot_holds_the_predicted_marker(tmp_path: Path, recording: Recording, effects: str) -> None:
    simulation = load_simulation(write_small_arm(tmp_path, CAMERA + effects))
    scene = scene_of(simulation, recording)
    assert predicted_by_links(scene, recording.q) == pytest.approx(scene.predicted, abs=1e-9)
    if effects:
        assert scene.predicted == pytest.approx(simulation.positions(Motion.of(recording)), abs=1e-12)


def test_a_camera_at_an_unknown_place_is_fitted(tmp_path: Path) -> None:
    q = np.random.default_rng(3).uniform(-1.0, 1.0, size=(40, 2))
    truth = load_simulation(write_small_arm(tmp_path, CAMERA))
    elsewhere = truth.robot.with_placement(np.eye(4), np.array([0.1, 0.0, 0.0])).chain.positions(q)
    robot = truth.robot.file
    robot.write_text(robot.read_text().replace('marker_link = "hand"', 'marker_link = "hand"\nmarker_known = false'))
    scene = scene_of(load_simulation(robot), Recording(JOINTS, q, elsewhere))
    assert scene.predicted == pytest.approx(elsewhere, abs=1e-6)


MESH = """<link name="upper"><visual><origin xyz="0.1 0 0" rpy="0 0 1.5707963"/>
<geometry><mesh filename="upper.stl" scale="0.001 0.001 0.001"/></geometry></visual></link>"""


def with_a_mesh(robot: Path) -> Path:
    """Give the upper arm a mesh of one triangle in mm."""
    urdf = robot.with_name("arm.urdf")
    urdf.write_text(urdf.read_text().replace('<link name="upper"/>', MESH))
    corners = np.array([[0, 0, 1], [0, 0, 0], [100, 0, 0], [0, 100, 0]], dtype="<f4")
    urdf.with_name("upper.stl").write_bytes(bytes(80) + b"\x01\0\0\0" + corners.tobytes() + b"\0\0")
    return robot


def test_meshes_keep_their_place_and_scale(tmp_path: Path, recording: Recording) -> None:
    scene = scene_of(load_simulation(with_a_mesh(write_small_arm(tmp_path, CAMERA))), recording)
    ((link, (mesh,)),) = scene.meshes.items()
    assert (link, mesh.file, mesh.place, mesh.scale) == ("upper", tmp_path / "upper.stl", (0.1, 0, 0), (0.001,) * 3)
    assert mesh.quaternion == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])


def test_rerun_reads_robot_cameras_and_both_markers(tmp_path: Path, recording: Recording) -> None:
    reader = pytest.importorskip("rerun.chunk").RrdReader
    robot, out = with_a_mesh(write_small_arm(tmp_path, CAMERA + BUMPED)), tmp_path / "a.rrd"
    recording.write_csv(tmp_path / "a.csv")
    app(["export", str(tmp_path / "a.csv"), str(out), "--robot", str(robot)], result_action="return_value")
    read: dict[str, np.ndarray] = {}
    meshes = 0
    for chunk in reader(out).stream():
        batch = chunk.to_record_batch()
        meshes += "Asset3D:blob" in batch.schema.names
        for name in batch.schema.names:
            if ":" in name and "Asset3D" not in name:
                read[f"{chunk.entity_path} {name}"] = np.array([row[0] for row in batch.column(name).to_pylist()])

    def pose(entity: str) -> tuple[Rotation, np.ndarray]:
        turn = Rotation.from_quat(read[f"{entity} Transform3D:quaternion"])
        return turn, read[f"{entity} Transform3D:translation"]

    assert read["/measurement_frame/left Pinhole:image_from_camera"][0].tolist() == [600, 0, 0, 0, 600, 0, 320, 240, 1]
    assert read["/measurement_frame/right Transform3D:translation"][0] == pytest.approx([0.2, 0.0, 0.0])
    (turned, place), (seen, eye) = pose("/robot/hand"), pose("/measurement_frame")
    shown = eye + seen.apply(read["/measurement_frame/predicted Points3D:positions"])
    assert shown == pytest.approx(place, abs=1e-6)
    assert not np.allclose(turned.as_rotvec()[0], turned.as_rotvec()[1])
    assert read["/measurement_frame/marker Points3D:positions"] == pytest.approx(recording.x, abs=1e-6)
    assert meshes == 1
    assert {"/robot/base LineStrips3D:strips", "/robot/upper LineStrips3D:strips"} <= read.keys()
