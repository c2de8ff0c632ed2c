"""`bodyschema run sampler` with emulated servos and cameras below OpenCV, or images in a folder."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from sampled import LIMIT_S, drawn, on_emulator, pairs_of, sampling, until
from v4l2_cameras import ShimCamera, preloaded

from bodyschema.daemon.config import Config
from bodyschema.interfaces.records import FloatArray

ARM = Path(__file__).parents[2] / "examples" / "desk_arm"
FPS, FRAMES = 30.0, 120
TRIES = 4
LATENCY_S = 0.070
MIDDLE = np.array([0.1, 0.4, 0.6, 0.0])
SWING = np.array([0.20, 0.12, 0.15, 0.10])
TURNS = np.array([[1, 3], [2, 3], [3, 5], [3, 2]])  # while all images are shown once: uneven


def angles(t: float) -> FloatArray:
    """Return the joints at a time; they repeat with the camera's images."""
    swing = np.sin(2 * math.pi * t * FPS / FRAMES * TURNS + np.array([[0.0, 0.7], [0.7, 1.9], [1.5, 0.2], [2.0, 1.0]]))
    return MIDDLE + SWING * (swing @ [0.6, 0.4])


@cache
def film() -> list[np.ndarray]:
    """Return side-by-side images of the arm, each as it was 70 ms before its time."""
    config = Config.load(ARM / "servos.toml", {})
    return [np.hstack(drawn(config, angles(k / FPS - LATENCY_S))) for k in range(FRAMES)]


def write_arm(folder: Path, free_endpoint: Callable[[], str], cameras: str, tables: str = "") -> Config:
    for name in ("desk_arm.urdf", "servos.toml"):
        shutil.copy(ARM / name, folder)
    toml = folder / "servos.toml"
    toml.write_text(toml.read_text().replace("baud =", "latency_ms = 100\nbaud ="))  # on a busy machine, patience
    with toml.open("a", encoding="utf-8") as file:
        file.write(f'\n[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n{tables}\n{cameras}')
    return Config.load(folder / "servos.toml", {})


CAMERA = """
[vision.cameras]
latency_s = {latency}
latency_sigma_s = 0.001
[vision.cameras.side_by_side]
device = "{device}"
image_size_px = [640, 480]
exposure_s = 0.005
"""


@pytest.fixture
def moving(tmp_path: Path, free_endpoint: Callable[[], str]) -> Iterator[tuple[Config, ShimCamera]]:
    """Yield a moving arm, and a stereo camera that sees it as it was 70 ms before each time stamp."""
    device = tmp_path / "dev" / "usb-Stereo_1234-video-index0"
    config = write_arm(tmp_path, free_endpoint, CAMERA.format(device=device, latency=LATENCY_S))
    with ShimCamera(device, film(), fps=FPS) as camera, on_emulator(config, tmp_path, angles) as (emulated, _):
        yield emulated, camera


@pytest.mark.soak  # with images in a folder: below; cameras below OpenCV: test_v4l2; latency_s: test_cameras
def test_servo_and_camera_samples_agree_in_time(library, moving) -> None:
    config, _ = moving
    with sampling(config, preloaded(library)) as sampler:
        until(sampler, lambda said: said.pairs >= 20)
    pairs = pairs_of(config)
    error = config.robot.chain.positions(np.array([pair.q for pair in pairs])) - [pair.x for pair in pairs]
    assert np.sqrt(np.mean(error**2)) < 1.5e-3  # 70 ms are 13 mm at this speed


@pytest.mark.soak
def test_unplugged_camera_is_reported_and_reopened(library, moving) -> None:
    config, camera = moving
    with sampling(config, preloaded(library)) as sampler:
        until(sampler, lambda said: said.pairs >= 5)
        camera.set(unplugged=1)
        lost = until(sampler, lambda said: any("cameras are lost" in text for text in said.health))
        until(sampler, lambda said: said.buses["arm"].exchanges > lost.buses["arm"].exchanges + 20)
        camera.set(unplugged=0)
        back = until(sampler, lambda said: said.pairs >= lost.pairs + 2)
        assert not any("cameras are lost" in text for text in back.health)


@pytest.mark.soak
def test_moving_arm_reveals_hidden_latency(library, moving) -> None:
    config, _ = moving
    file = config.file
    file.write_text(file.read_text().replace(f"latency_s = {LATENCY_S}", "latency_s = 0.01"))
    command = [sys.executable, "-m", "bodyschema", "calibrate", "latency", "--robot", str(file), "--json"]
    for attempt in range(TRIES):  # a busy machine takes images late or too few, and reports it: it then has more time
        longer = [*command, "--seconds", str(5.0 * 2**attempt)]
        done = subprocess.run(
            longer, check=False, env=preloaded(library), capture_output=True, text=True, timeout=LIMIT_S
        )
        if not any(told in done.stderr for told in ("is known to", "are needed", "Try again")):
            break
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert abs(found["latency_s"] - LATENCY_S) < 3 * found["sigma_s"] + 1e-3
    assert found["sigma_s"] < 3e-3


def test_servos_and_images_in_a_folder_give_pairs(tmp_path, free_endpoint) -> None:
    cameras = '[vision.cameras.images]\nleft = "left_*.png"\nright = "right_*.png"\ntimes = "times.txt"\n'
    config = write_arm(tmp_path, free_endpoint, cameras, "[daemon]\nany_step = true\n")
    # More and more seldom: they are not through before `until` gives up, however late a busy machine is for them.
    times = np.cumsum(np.linspace(0.1, 2.0, 600))
    assert times[-1] > 1.2 * LIMIT_S
    np.savetxt(tmp_path / "times.txt", times)
    for eye, image in zip(("left", "right"), drawn(config, MIDDLE), strict=True):
        cv2.imwrite(str(tmp_path / f"{eye}_0.png"), image)
        for number in range(1, len(times)):
            (tmp_path / f"{eye}_{number}.png").symlink_to(tmp_path / f"{eye}_0.png")
    with on_emulator(config, tmp_path, lambda t: MIDDLE) as (emulated, _), sampling(emulated) as sampler:
        until(sampler, lambda said: said.pairs >= 2)
    x = np.array([pair.x for pair in pairs_of(emulated)])
    assert np.abs(x - config.robot.chain.positions(MIDDLE[None])).max() < 3e-3
