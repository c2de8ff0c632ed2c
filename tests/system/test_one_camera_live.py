"""One webcam from its board to predictions: the commands of docs/one_camera.md on emulated servos and a live camera."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_renderer import Photographer, Printed, Taken, TrueLens, TrueRig, poses
from sampled import LIMIT_S, on_emulator
from v4l2_cameras import LiveCamera, preloaded

from bodyschema.daemon.config import Config
from bodyschema.interfaces.records import FloatArray
from kbmaps import RigidChain

# In real time, which a busy machine has too little of.
pytestmark = pytest.mark.soak

ARM = Path(__file__).parents[2] / "examples" / "desk_arm" / "desk_arm.urdf"
SIZE_PX, FPS, LATENCY_S, SIDE_M = (640, 480), 10.0, 0.2, 0.0498
LENS = TrueLens((600.0, 600.0), (319.5, 239.5), (0.0,) * 5)
WALL, MODULE_PX = 185, 12
TAG = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 0, 8 * MODULE_PX)
PRINT = np.pad(TAG // 2 + 30, MODULE_PX, constant_values=157)
NOISE = np.random.default_rng(0).normal(0.0, 2.0, SIZE_PX[::-1]).round().astype(np.int16)
SHOWN_S = 1.5  # how long the board is held still
BASE_TO_CAMERA = np.array([[0.0, 0.0, -1.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
MIDDLE, SWING = np.radians([10.0, 30.0, 45.0, 0.0]), np.radians([12.0, 12.0, 12.0, 20.0])
PACE = np.array([0.9, 0.7, 1.1, 0.5])  # [rad/s]
FACING = np.diag([1.0, -1.0, -1.0])
TABLES = """
[drivers.feetech.buses.arm]
port = "bus"
latency_ms = 300
"""
SERVO = """
[[drivers.feetech.servos]]
joint = "{joint}"
id = {id}
model = "STS3215"
"""


def guided(t: float) -> FloatArray:
    """Return the joints' angles, of a motion that does not repeat itself."""
    return MIDDLE + SWING * (0.6 * np.sin(PACE * t) + 0.4 * np.sin(2.3 * PACE[::-1] * t + 1.0))


@dataclass
class World:
    """What the camera sees: the board, held still at one pose after the other, or the tag on the arm."""

    chain: RigidChain
    boards: list[np.ndarray]
    shows_board: bool = True

    def seen(self, t: float) -> np.ndarray:
        """Return the image at a time."""
        if self.shows_board:
            return self.boards[int(t / SHOWN_S) % len(self.boards)]
        pose, middle = self.chain.poses(np.array([guided(t), MIDDLE]))
        return tag_at(pose[:3, :3] @ middle[:3, :3].T @ FACING, pose[:3, 3])


def tag_at(rotation: FloatArray, x: FloatArray) -> np.ndarray:
    """Return the image of the tag at x [m], quickly: the emulated servos answer from this process, too."""
    # From the print's pixels to the tag's plane, to the image, and to a third of its pixels.
    side = SIDE_M / (8.0 * MODULE_PX)
    plane = np.array([[side, 0.0, -5.0 * SIDE_M / 8.0], [0.0, -side, 5.0 * SIDE_M / 8.0], [0.0, 0.0, 1.0]])
    camera = np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]])
    finer = np.array([[3.0, 0.0, 1.0], [0.0, 3.0, 1.0], [0.0, 0.0, 1.0]])
    middles = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    shown = finer @ camera @ np.column_stack([rotation[:, :2], x]) @ plane @ middles
    size = 3 * SIZE_PX[0], 3 * SIZE_PX[1]
    seen = cv2.warpPerspective(PRINT, shown, size, borderMode=cv2.BORDER_CONSTANT, borderValue=WALL)
    seen = cv2.resize(cv2.GaussianBlur(seen, (0, 0), 1.5), SIZE_PX, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(cv2.add(seen, NOISE, dtype=cv2.CV_8U), cv2.COLOR_GRAY2BGR)


def boards(count: int) -> list[np.ndarray]:
    """Render the board at poses all over the image."""
    rng = np.random.default_rng(3)
    rig = TrueRig(LENS, LENS, np.eye(3), np.array([-0.12, 0.0, 0.0]), SIZE_PX)
    photographer = Photographer(rig, Printed(), Taken(), rng)
    return [photographer.left(*pose) for pose in poses(rng, rig, Printed(), count)]


def typed(*words: object, environment: dict[str, str]) -> str:
    """Type a command, and return what it prints."""
    command = [sys.executable, "-m", "bodyschema", *map(str, words)]
    done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 0, done.stderr
    return done.stdout


def with_servos(toml: Path, folder: Path, free_endpoint: Callable[[], str]) -> Config:
    """Add servos to a robot.toml, and make its camera as slow as the rendered one."""
    joints = Config.load(toml, {}).robot.joints
    text = toml.read_text().replace("fps = 30.0", f'fps = {FPS}\nfourcc = "YUYV"')
    text = text.replace("# state_dir", "state_dir").replace("min_step_deg", "any_step = true\nmin_step_deg")
    for port in ("7447", "7448"):
        text = text.replace(f"tcp/127.0.0.1:{port}", free_endpoint())
    servos = [SERVO.format(joint=joint, id=id) for id, joint in enumerate(joints, 1)]
    toml.write_text(text + TABLES + "".join(servos))
    return Config.load(toml, {})


def test_one_webcam_is_calibrated_and_its_arm_learnt(library, tmp_path, free_endpoint) -> None:
    environment, toml = preloaded(library), tmp_path / "robot.toml"
    device = tmp_path / "dev" / "usb-Webcam_1-video-index0"
    shutil.copy(ARM, tmp_path)
    type_ = partial(typed, environment=environment)
    type_("init", "--urdf", tmp_path / ARM.name, "--webcam", device, "--tag-mm", 1e3 * SIDE_M, "--robot", toml)
    config = with_servos(toml, tmp_path, free_endpoint)
    chain = config.robot.with_placement(BASE_TO_CAMERA, np.array([0.01, -0.01, 0.03])).chain
    world = World(chain, boards(30))
    with (
        on_emulator(config, tmp_path, guided) as (emulated, _),
        LiveCamera(device, np.full((*SIZE_PX[::-1], 3), 128, np.uint8), world.seen, fps=FPS, latency_s=LATENCY_S),
    ):
        robot = ("--robot", emulated.file)
        calibrated = json.loads(type_("calibrate", "cameras", *robot, "--json"))
        assert len(calibrated["views"]) >= 20
        world.shows_board = False
        found = type_("calibrate", "latency", *robot, "--seconds", 12, "--write")
        cameras = Config.load(emulated.file, {}).tables.vision.cameras
        assert cameras is not None
        assert cameras.latency_s == pytest.approx(LATENCY_S, abs=0.005), found
        running = subprocess.Popen([sys.executable, "-m", "bodyschema", "run", *map(str, robot)], env=environment)
        try:
            x = predicted(type_, robot)
        finally:
            running.terminate()
            running.wait(LIMIT_S)
    assert x == pytest.approx(chain.positions(MIDDLE[None])[0], abs=2e-3)


def predicted(type_: Callable[..., str], robot: tuple[object, ...]) -> list[float]:
    """Wait for 60 pairs and return where the learner expects the marker at the middle of the motion [m]."""
    until = time.monotonic() + LIMIT_S
    while time.monotonic() < until:
        time.sleep(2.0)
        try:
            reply = json.loads(type_("predict", *robot, "--json", "--", *MIDDLE))
        except AssertionError:  # the learner does not answer yet
            continue
        if reply["pairs"] >= 60:
            return reply["x"][0]
    raise AssertionError("too few samples")
