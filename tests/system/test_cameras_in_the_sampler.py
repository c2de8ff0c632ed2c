"""`bodyschema sampler` over servos of the bench and cameras below OpenCV, or images in a folder."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from v4l2_cameras import ShimCamera, compiled, preloaded

from daemon.bench_wiring import Motion, bench_robot_file, open_bench
from daemon.bus import Bus
from daemon.config import Config
from daemon.keys import Keys
from daemon.status import SamplerStatus
from daemon.store import PairReader
from daemon.wire import decode
from interfaces.errors import BodyschemaError
from interfaces.records import FloatArray, Pair

pytestmark = pytest.mark.timeout(240)
LIMIT_S = 90.0
ARM = Path(__file__).parents[2] / "examples" / "desk_arm"
FPS, FRAMES = 30.0, 240
LATENCY_S = 0.070
KEYS = Keys("desk_arm")
MIDDLE = np.array([0.1, 0.4, 0.6, 0.0])
SWING = np.array([0.20, 0.12, 0.15, 0.10])
TURNS = np.array([[2, 7], [3, 5], [5, 11], [7, 3]])  # while all images are shown once: uneven


def angles(t: float) -> FloatArray:
    """The joints at a time: they come back to where they were when the camera's images do."""
    swing = np.sin(2 * math.pi * t * FPS / FRAMES * TURNS + np.array([[0.0, 0.7], [0.7, 1.9], [1.5, 0.2], [2.0, 1.0]]))
    return MIDDLE + SWING * (swing @ [0.6, 0.4])


def limb(x: FloatArray, radius_m: float) -> FloatArray:
    """Where rays from the origin touch a sphere at x (3,) [m], points (n, 3) of a circle."""
    shrunk = 1.0 - radius_m**2 / float(x @ x)
    across = np.linalg.svd(x[None])[2][1:]
    turns = np.linspace(0.0, 2.0 * math.pi, 180, endpoint=False)
    return shrunk * x + radius_m * math.sqrt(shrunk) * np.stack([np.cos(turns), np.sin(turns)], axis=1) @ across


def drawn(config: Config, q: FloatArray) -> tuple[np.ndarray, np.ndarray]:
    """What the two eyes see of the marker ball."""
    calibration = config.robot.calibration
    assert calibration is not None
    x = config.robot.chain.positions(q[None])[0]
    width, height = calibration.image_size_px
    eyes = []
    for eye in range(2):
        seen = limb(x - [eye * calibration.baseline_m, 0.0, 0.0], config.tables.vision.radius_m)
        outline_px = calibration.focal_px * seen[:, :2] / seen[:, 2:] + calibration.principal_point_px
        image = np.full((2 * height, 2 * width, 3), 128, np.uint8)
        corners = np.round(16 * (2 * outline_px + 0.5)).astype(np.int32)
        cv2.fillPoly(image, [corners], (30, 30, 220), cv2.LINE_AA, 4)
        eyes.append(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
    return eyes[0], eyes[1]


def write_arm(folder: Path, free_endpoint: Callable[[], str], cameras: str, tables: str = "") -> Config:
    for name in ("desk_arm.urdf", "servos.toml"):
        shutil.copy(ARM / name, folder)
    toml = folder / "servos.toml"
    toml.write_text(toml.read_text().replace("baud =", "latency_ms = 100\nbaud ="))  # on a busy machine, patience
    with toml.open("a", encoding="utf-8") as file:
        file.write(f'\n[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n{tables}\n{cameras}')
    return Config.load(folder / "servos.toml", {})


@contextlib.contextmanager
def on_the_bench(config: Config, folder: Path, angle: Callable[[float], FloatArray]) -> Iterator[Config]:
    """The same arm with its servos on a bench, moving as `angle` says."""
    motion = {name: lambda t, j=j: float(angle(t)[j]) for j, name in enumerate(config.robot.joints)}
    bench = open_bench(config, folder / "bus", Motion(motion, "test"), return_delay_s=0.0, seed=0)
    file = bench_robot_file(config, bench, folder / "bus")
    with bench:
        yield Config.load(file, {})


@contextlib.contextmanager
def sampling(config: Config, environment: dict[str, str] | None = None) -> Iterator[Callable[[], SamplerStatus]]:
    """A sampler process, and what it says of itself."""
    command = [sys.executable, "-m", "daemon", "sampler", "--robot", str(config.file)]
    log = config.file.with_suffix(".log")
    with log.open("w") as errors:
        process = subprocess.Popen(command, env=environment, stderr=errors)
    try:
        with Bus(connect=config.tables.zenoh.sampler) as bus:
            yield lambda: told(bus, process, log)
        process.send_signal(signal.SIGTERM)
        assert process.wait(LIMIT_S) == 0
    finally:
        process.kill()
        process.wait()


def told(bus: Bus, process: subprocess.Popen[bytes], log: Path) -> SamplerStatus:
    until = time.monotonic() + LIMIT_S
    while True:
        try:
            return decode(bus.ask_one(KEYS.status("sampler")), SamplerStatus)
        except BodyschemaError:
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < until


def until(status: Callable[[], SamplerStatus], holds: Callable[[SamplerStatus], bool]) -> SamplerStatus:
    limit = time.monotonic() + LIMIT_S
    while not holds(said := status()):
        assert time.monotonic() < limit, (said.rejected, said)
        time.sleep(0.05)
    return said


def pairs_of(config: Config) -> list[Pair]:
    with PairReader(config.store_file) as reader:
        return list(reader.read())


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = compiled(tmp_path_factory.mktemp("shim"))
    if found is None:
        pytest.skip("no C compiler with V4L2's headers, so cameras cannot be emulated below OpenCV")
    return found


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
    """An arm that moves, and a stereo camera that sees it as it was 70 ms before each time stamp."""
    device = tmp_path / "dev" / "usb-Stereo_1234-video-index0"
    config = write_arm(tmp_path, free_endpoint, CAMERA.format(device=device, latency=LATENCY_S))
    images = [np.hstack(drawn(config, angles(k / FPS - LATENCY_S))) for k in range(FRAMES)]
    with ShimCamera(device, images, fps=FPS) as camera, on_the_bench(config, tmp_path, angles) as benched:
        yield benched, camera


def test_servos_and_a_stereo_camera_give_pairs_that_agree_in_time(library, moving) -> None:
    config, _ = moving
    with sampling(config, preloaded(library)) as status:
        until(status, lambda said: said.pairs >= 60)
    pairs = pairs_of(config)
    error = config.robot.chain.positions(np.array([pair.q for pair in pairs])) - [pair.x for pair in pairs]
    assert np.sqrt(np.mean(error**2)) < 1.5e-3  # 70 ms are 13 mm at this speed


def test_a_camera_that_is_unplugged_is_told_of_and_taken_again_while_the_servos_are_read_on(library, moving) -> None:
    config, camera = moving
    with sampling(config, preloaded(library)) as status:
        until(status, lambda said: said.pairs >= 5)
        camera.set(unplugged=1)
        lost = until(status, lambda said: any("cameras are lost" in text for text in said.health))
        until(status, lambda said: said.buses["arm"].exchanges > lost.buses["arm"].exchanges + 50)
        camera.set(unplugged=0)
        back = until(status, lambda said: said.pairs >= lost.pairs + 5)
        assert not any("cameras are lost" in text for text in back.health)


def test_a_hidden_latency_is_found_by_moving_the_arm(library, moving) -> None:
    config, _ = moving
    file = config.file
    file.write_text(file.read_text().replace(f"latency_s = {LATENCY_S}", "latency_s = 0.01"))
    command = [sys.executable, "-m", "daemon", "calibrate", "latency", "--robot", str(file), "--json"]
    done = subprocess.run(command, check=False, env=preloaded(library), capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert abs(found["latency_s"] - LATENCY_S) < 3 * found["sigma_s"] + 1e-3
    assert found["sigma_s"] < 3e-3


def test_servos_and_images_in_a_folder_give_pairs(tmp_path, free_endpoint) -> None:
    cameras = '[vision.cameras.images]\nleft = "left_*.png"\nright = "right_*.png"\nfps = 10.0\n'
    config = write_arm(tmp_path, free_endpoint, cameras, "[daemon]\nany_step = true\n")
    for number in range(200):
        if number == 0:
            for eye, image in zip(("left", "right"), drawn(config, MIDDLE), strict=True):
                cv2.imwrite(str(tmp_path / f"{eye}_0.png"), image)
        else:
            for eye in ("left", "right"):
                (tmp_path / f"{eye}_{number}.png").symlink_to(tmp_path / f"{eye}_0.png")
    with on_the_bench(config, tmp_path, lambda t: MIDDLE) as benched, sampling(benched) as status:
        until(status, lambda said: said.pairs >= 10)
    x = np.array([pair.x for pair in pairs_of(benched)])
    assert np.abs(x - config.robot.chain.positions(MIDDLE[None])).max() < 3e-3
