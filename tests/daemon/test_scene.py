from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from bodyschema.cli.demo.scene import _Settings, prepare
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.wiring import open_sources
from bodyschema.interfaces.errors import ConfigError
from bodyschema.vision.tags.body import TagBody

STICK_RADIUS_M = 0.005


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_folder_with_another_robot_is_refused_untouched(tmp_path) -> None:
    (tmp_path / "state").mkdir()
    for name in ("robot.toml", "recording.csv", "state/pairs.sqlite"):
        (tmp_path / name).write_text("mine")
    before = everything(tmp_path)
    with pytest.raises(ConfigError, match=r"no demo was here\. Give another --out"):
        prepare(tmp_path, seed=0)
    assert everything(tmp_path) == before


def test_earlier_demo_files_are_replaced(tmp_path) -> None:
    scene = prepare(tmp_path / "demo", seed=0)
    scene.recording_file.write_text("old")
    scene.store_file.parent.mkdir()
    scene.store_file.write_text("old")
    again = prepare(tmp_path / "demo", seed=1)
    assert not again.recording_file.exists()
    assert not again.store_file.exists()
    assert "seed = 1" in again.robot_file.read_text()


def test_demo_cube_tags_face_outwards_in_three_dimensions(tmp_path) -> None:
    vision = Config.load(prepare(tmp_path / "demo", seed=0, marker="cluster").robot_file).tables.vision
    body = TagBody.cluster(vision.cluster, vision.tag)
    middles = np.array([corners.mean(axis=0) for corners in body.corners.values()])
    normals = np.array([np.cross(c[1] - c[0], c[0] - c[3]) for c in body.corners.values()]) / vision.tag.side_m**2
    assert normals @ middles.T == pytest.approx(_Settings.cube_m / 2 * (normals @ normals.T), abs=1e-9)
    assert normals == pytest.approx(middles / (_Settings.cube_m / 2), abs=1e-6)
    assert np.linalg.matrix_rank(np.round(normals, 6)) == 3


def test_demo_tool_meets_single_tag_from_behind(tmp_path) -> None:
    """It would cover the tag from the front, and no frame would give a pair."""
    config = Config.load(prepare(tmp_path / "demo", seed=0, marker="tag").robot_file)
    ((corners,),) = [list(TagBody.cluster(config.tables.vision.cluster, config.tables.vision.tag).corners.values())]
    normal = np.cross(corners[1] - corners[0], corners[0] - corners[3])
    normal = normal / np.linalg.norm(normal)
    along_tool = np.linspace(0.0, 1.0, 50)[:, None] * -np.array(config.robot.robot.marker_xyz)
    assert ((along_tool - corners.mean(axis=0)) @ normal).max() < -STICK_RADIUS_M


@pytest.mark.parametrize(("marker", "looked_for"), [("ball", "ball"), ("tag", "cluster"), ("cluster", "cluster")])
def test_demo_tracks_the_marker_in_the_hand(tmp_path, marker, looked_for) -> None:
    assert Config.load(prepare(tmp_path / "demo", seed=0, marker=marker).robot_file).tables.vision.marker == looked_for


def test_demo_over_servos_reads_simulated_arm(tmp_path, caplog) -> None:
    pytest.importorskip("pybullet")
    caplog.set_level(logging.INFO)
    config = Config.load(prepare(tmp_path / "demo", seed=0, bus="dynamixel").robot_file)
    with open_sources(config, sim=True) as sources, sources.joints as joints, sources.marker as marker:
        while (reading := joints.read(0.05)) is None:
            marker.read(0.05)
    assert "7 servos, torque verified off" in caplog.text
    assert ((config.robot.lower <= reading.q) & (reading.q <= config.robot.upper)).all()
    assert np.abs(reading.q).max() > 0.1
