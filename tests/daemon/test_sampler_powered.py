"""Zero-force and gaze by command to the sampler, over zenoh."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from dataclasses import replace
from queue import Queue

import msgspec
import numpy as np
import pytest
from scripted_sources import Scripted, Walk
from small_arm import write_small_arm
from test_sampler import command, running, sample, status_when

from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.sources import Sources
from bodyschema.daemon.wiring.wiring import demonstration_model
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, RequestError
from bodyschema.interfaces.records import frozen_array

LIMIT_S = 500.0


class PoweredMode:
    """Joints with scripted answers."""

    name, state = "zero_force", "off"

    def __init__(self, answers=None) -> None:
        self.asked, self.complaints = [], ()
        self._answers = answers or {}

    def ask(self, on: bool) -> Future[str]:
        answer = Future()
        self.asked.append((on, answer))
        if on in self._answers:
            said = self._answers[on]
            answer.set_running_or_notify_cancel()
            answer.set_exception(said) if isinstance(said, Exception) else answer.set_result(said)
        return answer


@pytest.fixture
def config(tmp_path, endpoint: str) -> Config:
    return Config.load(
        write_small_arm(tmp_path, f'[zenoh]\nsampler = "{endpoint}"\n[daemon]\nstate_dir = "state"\n'), {}
    )


def sources(config: Config, drive: PoweredMode) -> Sources:
    held = threading.Event()
    joints, marker = Scripted([held], config.robot.joints), Scripted([held])
    return Sources(joints, marker, SystemClock(), powered=(drive,))


def test_command_returns_the_arm_s_answer(config) -> None:
    drive = PoweredMode({True: "it floats", False: "it is off"})
    with running(config, sources(config, drive)) as bus:
        assert command(bus, "zero_force_on") == "it floats"
        assert command(bus, "zero_force_off") == "it is off"
    assert [on for on, _ in drive.asked] == [True, False]


def test_a_refusal_is_the_answer(config) -> None:
    drive = PoweredMode({True: RequestError("joint 'elbow' is in operating mode 3")})
    with running(config, sources(config, drive)) as bus, pytest.raises(RequestError, match="in operating mode 3"):
        command(bus, "zero_force_on")


def test_unanswered_command_is_cancelled_after_timeout(config, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.daemon.sampler.sources.ANSWER_S", 0.05)
    drive = PoweredMode()
    with running(config, sources(config, drive)) as bus, pytest.raises(RequestError, match="not read at present"):
        command(bus, "zero_force_on")
    assert drive.asked[0][1].cancelled()


def test_unconfigured_command_is_refused(config) -> None:
    with (
        running(config, sources(config, PoweredMode())) as bus,
        pytest.raises(RequestError, match="gaze is not configured"),
    ):
        command(bus, "gaze_on")


def test_gaze_command_is_refused_in_simulation(config) -> None:
    simulated = replace(sources(config, PoweredMode()), simulation=object())
    with running(config, simulated) as bus, pytest.raises(RequestError, match="gaze is of a real arm"):
        command(bus, "gaze_on")


def test_its_complaints_are_in_the_status(config) -> None:
    drive = PoweredMode()
    drive.complaints = ("zero_force ended, torque off: it is too hot",)
    with running(config, sources(config, drive)) as bus:
        status = status_when(bus, lambda status: bool(status.health))
    assert drive.complaints[0] in status.health


class GazeMode(PoweredMode):
    """A head that stands still and records its commands."""

    name, head = "gaze", ("neck_yaw", "neck_pitch")
    lower, upper = frozen_array([-1.0, -1.0]), frozen_array([1.0, 1.0])

    def __init__(self) -> None:
        super().__init__()
        self.told: Queue = Queue()

    @property
    def pose(self):
        return time.monotonic(), np.radians([10.0, 20.0, 35.0, 15.0, 0.0, 80.0, 0.0])

    def aim(self, t, angles) -> None:
        self.told.put((t, angles))


def test_running_sampler_sends_gaze_angles_within_limits(tmp_path, endpoint) -> None:
    environment = {
        "BODYSCHEMA_ROBOT_NAME": "arm",
        "BODYSCHEMA_ZENOH_SAMPLER": endpoint,
        "BODYSCHEMA_DAEMON_STATE_DIR": str(tmp_path),
    }
    config, head, held = Config.load(demonstration_model(), environment), GazeMode(), threading.Event()
    joints, marker = Scripted([held], config.robot.joints), Scripted([held])
    with running(config, Sources(joints, marker, SystemClock(), powered=(head,), head=head)):
        first, _ = head.told.get(timeout=LIMIT_S)
        second, angles = head.told.get(timeout=LIMIT_S)
    assert second > first
    assert angles.shape == (2,)
    assert np.abs(angles).max() <= 1.0


def test_gaze_without_a_stereo_pair_is_refused(config) -> None:
    head, held = GazeMode(), threading.Event()
    joints, marker = Scripted([held], config.robot.joints), Scripted([held])
    with (
        pytest.raises(ConfigError, match="how the cameras see"),
        running(config, Sources(joints, marker, SystemClock(), head=head)),
    ):
        pass


def walking(config: Config, drive: PoweredMode) -> Sources:
    return replace(Walk(config.robot, 10).sources(), powered=(drive,))


@pytest.fixture
def borne(config) -> Config:
    section = msgspec.structs.replace(config.robot.robot, hold="zero_force")
    return replace(config, robot=replace(config.robot, robot=section))


def test_pairs_are_rejected_without_required_zero_force(borne) -> None:
    pairs, status = sample(borne, walking(borne, PoweredMode()))
    assert (pairs, status.rejected) == ([], {"not_borne": 10})
    assert any("zero_force is to bear the arm" in text for text in status.health)


def test_pairs_are_taken_while_zero_force_is_on(borne) -> None:
    drive = PoweredMode()
    drive.state = "on"
    assert len(sample(borne, walking(borne, drive))[0]) == 10


class Cameras:
    """Cameras with a health warning."""

    health = ("the left camera's image is black: is the lens cap on?",)


def test_camera_warnings_are_in_the_status(config) -> None:
    with running(config, replace(sources(config, PoweredMode()), cameras=Cameras())) as bus:
        assert Cameras.health[0] in status_when(bus, lambda status: bool(status.health)).health
