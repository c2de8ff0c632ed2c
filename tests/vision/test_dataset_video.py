"""The marker in the videos of a LeRobotDataset, and in the images of a ROS bag."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from ball_renderer import SMALL
from scenes import Ball, stage

from bodyschema.cli.recordings.foreign import markers_in_images, markers_in_video
from bodyschema.daemon.config import Config
from bodyschema.interfaces.errors import ConfigError, RecordingError
from bodyschema.vision.cameras import videos

pa = pytest.importorskip("pyarrow")
sys.path.append(str(Path(__file__).parents[1] / "daemon"))
from small_arm import write_small_arm  # noqa: E402

FPS, CAMERA = 20.0, "observation.images.front"
CAMERA_TABLE = """eyes = 1
focal_px = 600.0
principal_point_px = [159.5, 119.5]
image_size_px = [320, 240]
[vision]
radius_m = 0.02
"""


def path(episode: int, frames: int) -> list[Ball]:
    """Return where the ball is in each frame of an episode."""
    return [Ball((0.02 * k / frames - 0.01 * episode, 0.01 * episode, 0.5), 0.02) for k in range(frames)]


def film(file: Path, balls: list[Ball]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), FPS, SMALL.image_size_px)
    for ball in balls:
        writer.write(stage(ball).images[0])
    writer.release()


def dataset(folder: Path, version: str) -> Path:
    """Write the videos of two episodes of 6 and 4 frames, with what describes them."""
    import pyarrow.parquet as pq

    (folder / "meta").mkdir(parents=True)
    features = {CAMERA: {"dtype": "video", "names": ["height", "width", "channels"]}}
    told = {"codebase_version": version, "robot_type": "so101_follower", "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(told))
    if version == "v2.1":
        for episode, frames in enumerate((6, 4)):
            file = folder / "videos" / "chunk-000" / CAMERA / f"episode_{episode:06d}.mp4"
            film(file, path(episode, frames))
        return folder
    film(folder / "videos" / CAMERA / "chunk-000" / "file-000.mp4", path(0, 6) + path(1, 4))
    episodes = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    episodes.parent.mkdir(parents=True)
    columns = {"episode_index": [0, 1], "chunk_index": [0, 0], "file_index": [0, 0]}
    columns |= {"from_timestamp": [0.0, 6 / FPS], "to_timestamp": [6 / FPS, 10 / FPS]}
    named = {key if key == "episode_index" else f"videos/{CAMERA}/{key}": value for key, value in columns.items()}
    pq.write_table(pa.table(named), episodes)
    return folder


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return Config.load(write_small_arm(tmp_path, CAMERA_TABLE), {})


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_the_ball_is_followed_episode_by_episode(version: str, config: Config, tmp_path: Path) -> None:
    track = markers_in_video(config, dataset(tmp_path / "data", version), CAMERA)
    assert track.run.tolist() == [0] * 6 + [1] * 4
    np.testing.assert_allclose(track.t, [k / FPS for frames in (6, 4) for k in range(frames)], atol=1e-6)
    wanted = np.array([ball.x for episode, frames in enumerate((6, 4)) for ball in path(episode, frames)])
    # Compression moves the disc's outline by about a tenth of a pixel.
    np.testing.assert_allclose(track.x[:, :2], wanted[:, :2], atol=5e-4)
    np.testing.assert_allclose(track.x[:, 2], wanted[:, 2], rtol=0.03)


def test_configured_readout_time_applies_to_videos(tmp_path: Path) -> None:
    cameras = '[vision.cameras]\nreadout_s = 0.02\n[vision.cameras.one]\ndevice = "usb"\nimage_size_px = [320, 240]\n'
    config = Config.load(write_small_arm(tmp_path, CAMERA_TABLE + cameras), {})
    track = markers_in_video(config, dataset(tmp_path / "data", "v2.1"), CAMERA)
    rows = SMALL.project(track.x[6])[1] / 240.0  # the second episode's ball is 12 pixels below the middle
    assert track.t[6] == pytest.approx(0.02 * (rows - 0.5), abs=1e-6)
    assert track.t[6] > 0.0005


def test_a_camera_that_is_not_there_is_named(config: Config, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=f"no video observation.images.top.*It has {CAMERA}"):
        markers_in_video(config, dataset(tmp_path / "data", "v2.1"), "observation.images.top")


def test_av1_video_without_pyav_names_the_package(config: Config, tmp_path: Path, monkeypatch) -> None:
    folder = dataset(tmp_path / "data", "v2.1")
    codec = cv2.VideoCapture(str(next(folder.rglob("*.mp4")))).get(cv2.CAP_PROP_FOURCC)
    monkeypatch.setattr(videos, "_AV1", round(codec))
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ConfigError, match=r"is in AV1, which OpenCV cannot decode.*pip install av\. Or convert it"):
        markers_in_video(config, folder, CAMERA)


def test_ball_is_followed_in_lerobot_av1_video(config: Config, tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="no PyAV; to run it: pip install av")
    folder = dataset(tmp_path / "data", "v2.1")
    for episode, file in enumerate(sorted(folder.rglob("*.mp4"))):
        with av.open(str(file), "w") as container:
            stream = container.add_stream("libsvtav1", rate=int(FPS), options={"crf": "30", "g": "2"})
            stream.width, stream.height = SMALL.image_size_px
            stream.pix_fmt = "yuv420p"
            for ball in path(episode, (6, 4)[episode]):
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(stage(ball).images[0]), format="bgr24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    track = markers_in_video(config, folder, CAMERA)
    assert track.run.tolist() == [0] * 6 + [1] * 4
    wanted = np.array([ball.x for episode, frames in enumerate((6, 4)) for ball in path(episode, frames)])
    np.testing.assert_allclose(track.x[:, :2], wanted[:, :2], atol=5e-4)


def test_a_video_that_cannot_be_decoded_is_refused(config: Config, tmp_path: Path) -> None:
    folder = dataset(tmp_path / "data", "v2.1")
    next(folder.rglob("*.mp4")).write_bytes(b"no video" * 100)
    with pytest.raises(ConfigError, match=r"is not a readable video.*ffmpeg -i"):
        markers_in_video(config, folder, CAMERA)


def test_ball_is_followed_in_compressed_bag_images(config: Config, tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from written_bags import BEGUN_S, compressed_image, write_bag

    balls, times = path(0, 6), [k / FPS for k in range(6)]
    jpegs = [cv2.imencode(".jpg", stage(ball).images[0])[1].tobytes() for ball in balls]
    sent = [(t, compressed_image(t, jpeg)) for t, jpeg in zip([*times, times[-1]], [*jpegs, jpegs[-1]], strict=True)]
    bag = write_bag(tmp_path / "bag", {"/camera/image/compressed": ("CompressedImage", sent)}, mcap=True)
    track = markers_in_images(config, bag, "/camera/image/compressed")
    np.testing.assert_allclose(track.t - BEGUN_S, times, atol=1e-6)
    np.testing.assert_allclose(track.x[:, :2], [ball.x[:2] for ball in balls], atol=5e-4)
    with pytest.raises(RecordingError, match=r"--video /tag: there is no such topic of .*[.?] The bag has"):
        markers_in_images(config, bag, "/tag")
