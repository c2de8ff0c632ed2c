"""An SO-101 with one webcam: from a LeRobotDataset with its video to joint offsets and the error on held-out poses."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes import Ball, stage
from typed_pages import DOCS, TypedPage, expected_mm

from bodyschema.cli.main import command_line
from bodyschema.daemon.config import Config
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.robot.lerobot import read_calibration
from bodyschema.vision.rig.lens import Lens
from bodyschema.vision.rig.rig_file import write_rig
from bodyschema.vision.rig.stereo_rig import CalibrationProvenance, OneEyeRig

pytest.importorskip("pyarrow")
sys.path.append(str(DOCS.parent / "tests" / "daemon"))
from lerobot_datasets import write_dataset

SO101, FRONT = DOCS.parent / "examples" / "so101", "observation.images.front"
WEBCAM = StereoCalibration(500.0, (319.5, 239.5), 0.06, (640, 480))
T_BASE_CAMERA = np.array([[0.0, 0.0, -1.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]])
OFFSETS_DEG = np.array([0.0, 2.5, -3.0, 1.5, 0.0])
FAST, SLOW = [0.78, 1.0, 1.4, 1.9, 1.1], [0.25, 0.34, 0.43, 0.52, 0.38]  # [rad/s]
BALL_MM, FRAMES, RATE_HZ = 40.0, 150, 12.0
MADE = CalibrationProvenance("2026-01-01T00:00:00Z", "a board", 20, 0, 0.05, 0.05, 1e-4)


def film(file: Path, places: np.ndarray) -> None:
    file.parent.mkdir(parents=True)
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), RATE_HZ, WEBCAM.image_size_px)
    for k, x in enumerate(places):
        writer.write(stage(Ball(tuple(x), 5e-4 * BALL_MM), calibration=WEBCAM, seed=k).images[0])
    writer.release()


def dataset(folder: Path, config: Config) -> None:
    """Write an episode in which the arm is moved slowly wherever the webcam sees the ball."""
    robot, t = config.robot, np.arange(1000) / RATE_HZ
    q = 0.5 * robot.upper * (np.sin(np.outer(t, FAST)) + np.sin(np.outer(t, SLOW) + 1.0))
    chain = robot.with_placement(T_BASE_CAMERA, np.array([0.01, -0.01, 0.02])).chain
    places = chain.positions(q + np.radians(OFFSETS_DEG))
    pixels = WEBCAM.project(places)[:, :2]
    seen = (places[:, 2] > 0.3) & (pixels > 40).all(axis=1) & (pixels < [600, 440]).all(axis=1)
    begin = int(np.argmax(np.convolve(seen, np.ones(FRAMES), "valid")))  # the stretch with most of them
    q, places, t = q[begin : begin + FRAMES], places[begin : begin + FRAMES], t[:FRAMES]
    motors = read_calibration(Path("follower.json"))
    write_dataset(folder, "v2.1", "degrees", motors, [(t, np.column_stack([q, q[:, 0]]))], fps=RATE_HZ)
    info = json.loads((folder / "meta" / "info.json").read_text())
    info["features"][FRONT] = {"dtype": "video", "names": ["height", "width", "channels"]}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    film(folder / "videos" / "chunk-000" / FRONT / "episode_000000.mp4", places)


@pytest.mark.soak
def test_webcam_dataset_gives_joint_offsets(tmp_path: Path, monkeypatch, capsys) -> None:
    shutil.copytree(SO101, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    page = TypedPage((DOCS / "lerobot.md").read_text(encoding="utf-8"), capsys)
    of = "--lerobot so101 --urdf so101.urdf --calibration follower.json --port ./bus"
    words = f"init {of} --webcam /dev/v4l/by-id/cam --ball-mm {BALL_MM:g}".split()
    command_line("init")(words, exit_on_error=False, result_action="return_value")
    lens = Lens("pinhole", (WEBCAM.focal_px,) * 2, WEBCAM.principal_point_px, (0.0,) * 5)
    write_rig(OneEyeRig(lens, WEBCAM.image_size_px, ("",), 1e-4 * np.eye(9), MADE), Path("cameras.toml"))
    dataset(Path("my_dataset"), Config.load(Path("robot.toml"), {}))
    told = page.type(
        f"bodyschema export my_dataset so101.csv --video {FRONT} --lerobot follower.json --lerobot-unit degrees"
    )
    assert int(told.split()[0]) > 0.9 * FRAMES
    before = expected_mm(page.type("bodyschema calibrate so101.csv --trust-urdf"))
    found = page.type("bodyschema calibrate so101.csv --only offsets --lerobot follower.json")
    read = [float(degrees) for degrees in re.findall(r"readings ([+-][\d.]+)°", found)]
    assert read == pytest.approx(OFFSETS_DEG[1:4], abs=0.3)
    assert expected_mm(found)[0] < before[0] / 2
