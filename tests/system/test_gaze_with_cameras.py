"""`bodyschema run sampler` with gaze: an emulated head of two servos, which carries cameras below OpenCV."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from sampled import LIMIT_S, SamplerProcess, drawn, on_emulator, pairs_of, sampling, until
from v4l2_cameras import LiveCamera, preloaded

from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.wiring import demonstration_model
from bodyschema.drivers.emulator.dry_run import DryRun
from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.pointing import Pointing

# In real time, which a busy machine has too little of; in virtual time, gaze is in drivers/test_gaze.py.
pytestmark = pytest.mark.soak

HEAD = [0, 1]
DIRECTIONS = [1, -1, 1, 1, 1, 1, 1]  # of the servos
MIDDLE = np.radians([0.0, 20.0, 35.0, -15.0, 0.0, 80.0, 0.0])
SWING = np.radians([0.0, 0.0, 12.0, 12.0, 35.0, 0.0, 0.0])
PACE = np.array([0.0, 0.0, 0.65, 0.5, 0.75, 0.5, 0.5])  # so slow that a busy machine can turn the head in time
AT_FIRST_S, FOUND_S, WATCHED_S = 2.0, 1.0, 8.4  # the head has found the hand; once to and fro
EVERY_S = 0.05
SPEED_DEG_S, YAW_DEG = 60.0, (-30.0, 40.0)
FPS, LATENCY_S = 10.0, 0.25  # a busy machine renders images late
PAIRS = 25  # a busy machine makes fewer in a second
GREY = np.full((480, 1280, 3), 128, np.uint8)
OVERLOAD = 0x20
TABLES = f"""
[drivers.dynamixel]
rate_hz = 60

[drivers.dynamixel.buses.arm]
port = "bus"
latency_ms = 400

[drivers.dynamixel.gaze]
joints = ["neck_yaw", "neck_pitch"]
max_speed_deg_s = {SPEED_DEG_S}
limits_deg = {{{{ neck_yaw = [{YAW_DEG[0]}, {YAW_DEG[1]}] }}}}
heartbeat_ms = 2500

[vision]
radius_m = 0.025

[vision.cameras]
latency_s = {LATENCY_S}
latency_sigma_s = 0.001

[vision.cameras.side_by_side]
device = "{{device}}"
image_size_px = [640, 480]
fps = {FPS}
fourcc = "YUYV"

[daemon]
any_step = true
state_dir = "state"

[zenoh]
sampler = "{{sampler}}"
learner = "{{learner}}"
"""
SERVO = """
[[drivers.dynamixel.servos]]
joint = "{joint}"
id = {id}
model = "XM430-W350"
direction = {direction}
"""


def looking_at_the_hand(robot: RobotDescription) -> FloatArray:
    """Return the pose in which the arm waits, its head turned so that the cameras see the hand."""
    assert robot.calibration is not None
    pointing = Pointing(robot.calibration, HEAD, robot.lower[HEAD], robot.upper[HEAD])
    q = MIDDLE[None].copy()
    for _ in range(20):
        q[:, HEAD] = pointing.clipped(q[:, HEAD] + pointing.step(q, robot.chain.positions))
    return q[0]


class Guided:
    """A hand that guides the arm, once it begins; the head is left alone."""

    def __init__(self, start: FloatArray) -> None:
        self.start, self.begin_s = start, math.inf

    def __call__(self, t: float) -> FloatArray:
        return self.start + SWING * np.sin(PACE * max(t - self.begin_s, 0.0))


@dataclass(frozen=True)
class Watched:
    """Observations over a while.

    Attributes:
        t, q: times [s] and positions of the joints [rad], shapes (n,) and (n, d).
        torque: all observed torque registers of the servos.
        pairs: pairs made meanwhile.
        health: the sampler's last health messages.
    """

    t: FloatArray
    q: FloatArray
    torque: set[tuple[int, ...]]
    pairs: list[Pair]
    health: list[str]


@dataclass(frozen=True)
class Episode:
    """A sampler from start to end: first without gaze, then with it, then with a failed servo of the head.

    Attributes:
        torque_again: after it was asked for once more. torque_at_exit: after SIGTERM.
    """

    robot: RobotDescription
    without: Watched
    gazing: Watched
    failed: Watched
    torque_again: tuple[int, ...]
    torque_at_exit: tuple[int, ...]


class Stage:
    """An arm with an emulated head, and the cameras that the head carries."""

    def __init__(self, config: Config, emulator: DryRun, guided: Guided) -> None:
        self.config, self._emulator, self._guided = config, emulator, guided
        self.head = [emulator.arm.servo(joint) for joint in config.robot.joints[:2]]

    def q(self, t: float) -> FloatArray:
        """Return the joint positions [rad] (d,)."""
        q = self._guided(t)
        q[HEAD] = [way * servo.angle(t) for way, servo in zip(DIRECTIONS, self.head, strict=False)]
        return q

    def seen(self, t: float) -> np.ndarray:
        """Return the cameras' images side by side."""
        return np.hstack(drawn(self.config, self.q(t)))

    @property
    def torque(self) -> tuple[int, ...]:
        """Torque register of each servo."""
        return tuple(self._emulator.arm.servo(joint)["torque"] for joint in self.config.robot.joints)

    def watch(self, sampler: SamplerProcess, seconds: float, pairs: int = 0) -> Watched:
        """Observe for at least this time and this many pairs."""
        begin, first, torque, seen = time.monotonic(), len(pairs_of(self.config)), set(), []
        while time.monotonic() < begin + seconds or len(pairs_of(self.config)) < first + pairs:
            assert time.monotonic() < begin + LIMIT_S
            torque.add(self.torque)
            t = time.monotonic() - EVERY_S  # the emulator was asked since
            seen.append((t, self.q(t)))
            time.sleep(EVERY_S)
        t, q = zip(*seen, strict=True)
        return Watched(np.array(t), np.array(q), torque, pairs_of(self.config)[first:], sampler.status().health)


def write_robot(folder: Path, free_endpoint: Callable[[], str], device: Path) -> Config:
    """Write the demonstration's upper body, with servos, gaze and a camera."""
    shutil.copytree(demonstration_model().parent, folder, dirs_exist_ok=True)
    toml = folder / "robot.toml"
    servos = [
        SERVO.format(joint=joint, id=id, direction=way)
        for id, (joint, way) in enumerate(zip(Config.load(toml, {}).robot.joints, DIRECTIONS, strict=True), 1)
    ]
    tables = TABLES.format(device=device, sampler=free_endpoint(), learner=free_endpoint())
    toml.write_text(toml.read_text() + tables + "".join(servos))
    return Config.load(toml, {})


@pytest.fixture(scope="module")
def episode(library, tmp_path_factory, free_endpoint) -> Episode:
    folder = tmp_path_factory.mktemp("gaze")
    device = folder / "dev" / "usb-Stereo_1234-video-index0"
    config = write_robot(folder, free_endpoint, device)
    guided = Guided(looking_at_the_hand(config.robot))
    with on_emulator(config, folder, guided) as (emulated, emulator):
        stage = Stage(emulated, emulator, guided)
        with (
            LiveCamera(device, GREY, stage.seen, fps=FPS, latency_s=LATENCY_S),
            sampling(emulated, preloaded(library)) as sampler,
        ):
            until(sampler, lambda said: said.pairs >= 1)
            guided.begin_s = time.monotonic()
            without = stage.watch(sampler, AT_FIRST_S)
            sampler.command("gaze_on")
            stage.watch(sampler, FOUND_S)
            gazing = stage.watch(sampler, WATCHED_S, PAIRS)
            stage.head[1].fail(OVERLOAD)
            until(sampler, lambda said: any("gaze ended" in text for text in said.health))
            time.sleep(EVERY_S)  # later observations are after the end
            failed = stage.watch(sampler, 0.5)
            stage.head[1].reboot(time.monotonic())
            sampler.command("gaze_on")
            again = stage.torque
        return Episode(config.robot, without, gazing, failed, again, stage.torque)


def in_view(robot: RobotDescription, q: FloatArray) -> np.ndarray:
    """Return a mask (n,) of the rows of q (n, d) at which both cameras have the marker's centre in view."""
    calibration = robot.calibration
    assert calibration is not None
    x, eyes = robot.chain.positions(q), [[0.0, 0.0], [calibration.baseline_m, 0.0]]
    pixels = [(x[:, :2] - eye) / x[:, 2:] * calibration.focal_px + calibration.principal_point_px for eye in eyes]
    return np.all([((p >= 0) & (p < calibration.image_size_px)).all(axis=1) for p in pixels], axis=0)


def with_the_head_still(episode: Episode, q: FloatArray) -> FloatArray:
    """Return q (n, d) with the head at its position before the gaze began."""
    q = q.copy()
    q[:, HEAD] = episode.without.q[0, HEAD]
    return q


def test_gaze_keeps_hand_in_both_images(episode) -> None:
    q = episode.gazing.q
    lost, without = (1.0 - in_view(episode.robot, poses).mean() for poses in (q, with_the_head_still(episode, q)))
    assert without > 0.2
    assert lost < 0.4 * without


def test_moving_head_samples_beyond_fixed_view(episode) -> None:
    q = np.array([pair.q for pair in episode.gazing.pairs])
    unseen = ~in_view(episode.robot, with_the_head_still(episode, q))
    assert unseen.mean() > 0.1
    assert in_view(episode.robot, np.array([pair.q for pair in episode.without.pairs])).all()


def test_samples_stay_accurate_while_head_turns(episode) -> None:
    pairs = episode.gazing.pairs
    error = episode.robot.chain.positions(np.array([pair.q for pair in pairs])) - [pair.x for pair in pairs]
    assert np.median(np.linalg.norm(error, axis=1)) < 3e-3


def test_head_has_no_torque_until_asked(episode) -> None:
    assert np.ptp(episode.without.q[:, HEAD], axis=0).max() < 1e-9
    assert episode.without.torque == {(0, 0, 0, 0, 0, 0, 0)}


def test_only_the_head_has_torque(episode) -> None:
    assert episode.gazing.torque == {(1, 1, 0, 0, 0, 0, 0)}


def test_the_head_keeps_its_speed(episode) -> None:
    t, head = episode.gazing.t, episode.gazing.q[:, HEAD].T
    seconds = np.arange(t[0], t[-1] - 1.0, EVERY_S)
    turned = [np.interp(seconds + 1.0, t, angle) - np.interp(seconds, t, angle) for angle in head]
    assert np.degrees(np.abs(turned)).max() < 1.2 * SPEED_DEG_S


def test_head_reaches_but_respects_its_limits(episode) -> None:
    yaw = np.degrees(episode.gazing.q[:, 0])
    assert YAW_DEG[0] - 0.2 <= yaw.min() < YAW_DEG[0] + 1.0
    assert yaw.max() <= YAW_DEG[1] + 0.2


def test_head_fault_stops_torque_and_reports_once(episode) -> None:
    assert episode.failed.torque == {(0, 0, 0, 0, 0, 0, 0)}
    assert np.ptp(episode.failed.q[:, HEAD], axis=0).max() < 1e-9
    assert sum("gaze ended, torque off" in text for text in episode.failed.health) == 1


def test_gaze_restarts_and_signal_ends_without_torque(episode) -> None:
    assert episode.torque_again == (1, 1, 0, 0, 0, 0, 0)
    assert episode.torque_at_exit == (0, 0, 0, 0, 0, 0, 0)
