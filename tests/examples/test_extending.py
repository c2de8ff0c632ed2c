"""The package of docs/extending.md, installed beside bodyschema: its driver, its tracker and its effect are used."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.wiring import open_joints
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, SourceLost
from bodyschema.interfaces.records import MarkerFix, MarkerMiss, Reason, StereoFrame
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.plugins import PluginConfig
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tracked_camera import MarkerTracker
from bodyschema.vision.trackers import tracker_of

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
LIMIT_S = 500.0
CAMERAS = StereoCalibration(
    focal_px=700.0, principal_point_px=(320.0, 240.0), baseline_m=0.12, image_size_px=(640, 480), pixel_sigma=0.2
)


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the example installed in it."""
    folder = tmp_path_factory.mktemp("packages")
    source = shutil.copytree(ROOT / "examples" / "extending", tmp_path_factory.mktemp("source") / "extending")
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "install", *options, "--target", folder, source]
    subprocess.run(command, check=True, timeout=LIMIT_S)
    return folder


@pytest.fixture
def installed(packages: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(packages))


@pytest.fixture
def robot_toml(tmp_path: Path) -> Path:
    """Copy the desk arm to a folder of its own and return its robot.toml."""
    for name in ("robot.toml", "desk_arm.urdf"):
        shutil.copy(ROOT / "examples" / "desk_arm" / name, tmp_path)
    return tmp_path / "robot.toml"


def with_udp(robot_toml: Path, port: int, name: str = "udp") -> Config:
    robot_toml.write_text(
        f'{robot_toml.read_text()}\n[drivers.plugin]\nname = "{name}"\n[drivers.plugin.settings]\nport = {port}\n'
    )
    return Config.load(robot_toml, {})


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_driver_reads_what_a_controller_sends(installed, robot_toml: Path) -> None:
    port = free_port()
    config = with_udp(robot_toml, port)
    with open_joints(config, SystemClock()) as joints, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as controller:
        controller.sendto(b"0.1 0.2 0.3 0.4", ("127.0.0.1", port))
        assert joints.read(5.0).q.tolist() == [0.1, 0.2, 0.3, 0.4]
        for wrong in (b"0.1 0.2 0.3", b"0.1 0.2 nan 0.4", b"\xff" * 3000):
            controller.sendto(wrong, ("127.0.0.1", port))
            assert joints.read(5.0) is None
        assert "3 datagrams were not 4 numbers" in joints.health[0]


def test_driver_reports_port_in_use(installed, robot_toml: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        config = with_udp(robot_toml, other.getsockname()[1])
        with pytest.raises(SourceLost, match="Who else listens there"), open_joints(config, SystemClock()):
            pass


def test_uninstalled_driver_error_names_its_line(installed, robot_toml: Path) -> None:
    with pytest.raises(ConfigError, match=r"line \d+: no installed package has a plugin 'upd'.*Did you mean 'udp'"):
        with_udp(robot_toml, 5005, name="upd")


def dotted(*eyes: tuple[float, float] | None) -> StereoFrame:
    """Return both cameras' images of a green dot at these places (column, row)."""
    v, u = np.mgrid[0:480, 0:640]
    images = []
    for place in eyes:
        image = np.full((480, 640, 3), 30.0)
        if place is not None:
            image[:, :, 1] += 220.0 * np.exp(-0.5 * ((u - place[0]) ** 2 + (v - place[1]) ** 2) / 1.5**2)
        images.append(image.astype(np.uint8))
    return StereoFrame(1.0, images[0], images[1])


@pytest.fixture
def tracker(installed) -> MarkerTracker:
    return tracker_of(CAMERAS, VisionConfig(marker="plugin", plugin=PluginConfig("laser_dot")))


def test_the_tracker_finds_the_dot_where_it_is(tracker: MarkerTracker) -> None:
    fix = tracker.track(dotted((400.25, 200.5), (260.25, 200.5)))
    assert isinstance(fix, MarkerFix)
    depth = 700.0 * 0.12 / 140.0
    np.testing.assert_allclose(fix.x, [80.25 * depth / 700.0, -39.5 * depth / 700.0, depth], atol=2e-3)


@pytest.mark.parametrize(
    ("eyes", "reason"),
    [(((400.0, 200.0), None), Reason.NO_MARKER), (((400.0, 200.0), (260.0, 210.0)), Reason.EPIPOLAR)],
)
def test_the_tracker_tells_why_there_is_no_dot(tracker: MarkerTracker, eyes, reason: Reason) -> None:
    assert tracker.track(dotted(*eyes)) == MarkerMiss(1.0, reason)


def test_hidden_effect_is_found_and_described(packages: Path, robot_toml: Path) -> None:
    robot = RobotDescription.load(robot_toml)
    rng = np.random.default_rng(0)
    q = rng.uniform(0.9 * robot.lower, 0.9 * robot.upper, (200, len(robot.joints)))
    turned = q.copy()
    travelled = (q[:, 2] + np.radians(150.0)) / np.radians(300.0)
    turned[:, 2] += np.radians(300.0) * 0.12 * travelled**2 * (1.0 - travelled)
    x = robot.chain.positions(turned) + 5e-4 * rng.normal(size=(len(q), 3))
    stated = np.tile(np.square(5e-4) * np.eye(3), (len(q), 1, 1))
    Recording(robot.joints, q, x, cov=stated).write_csv(robot_toml.parent / "measured.csv")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(packages), str(ROOT)])}
    command = [sys.executable, "-m", "bodyschema", "diagnose", "measured.csv", "--json"]
    run = subprocess.run(
        command, capture_output=True, timeout=LIMIT_S, check=True, cwd=robot_toml.parent, env=environment
    )
    found = msgspec.json.decode(run.stdout)
    causes = [(cause["effect"], cause["where"]) for cause in found["causes"]]
    assert causes == [("potentiometer_loading", robot.joints[2])]
    assert found["causes"][0]["parameters"]["loading"]["value"] == pytest.approx(0.12, abs=0.01)
    assert f"the potentiometer of joint {robot.joints[2]} is loaded" in found["sentence"].lower()


@pytest.mark.parametrize("file", ["udp_joints.py", "laser_dot.py", "potentiometer.py"])
def test_the_page_names_each_file(file: str) -> None:
    assert f"../examples/extending/bodyschema_lab/{file}" in PAGE
