"""Zero-force and gaze by command to the sampler, over zenoh."""

from __future__ import annotations

import threading
from concurrent.futures import Future

import pytest
from scripted_sources import Scripted
from small_arm import write_small_arm
from test_sampler import command, running, status_when

from daemon import powered
from daemon.config import Config
from daemon.sources import Sources
from interfaces.clock import SystemClock
from interfaces.errors import RequestError


class Powered:
    """Joints that answer as told."""

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


def sources(config: Config, drive: Powered) -> Sources:
    held = threading.Event()
    joints, marker = Scripted([held], config.robot.joints), Scripted([held])
    return Sources(joints, marker, SystemClock(), powered=(drive,))


def test_what_the_arm_says_is_the_answer(config) -> None:
    drive = Powered({True: "it floats", False: "it is off"})
    with running(config, sources(config, drive)) as bus:
        assert command(bus, "zero_force_on") == "it floats"
        assert command(bus, "zero_force_off") == "it is off"
    assert [on for on, _ in drive.asked] == [True, False]


def test_a_refusal_is_the_answer(config) -> None:
    drive = Powered({True: RequestError("joint 'elbow' is in operating mode 3")})
    with running(config, sources(config, drive)) as bus, pytest.raises(RequestError, match="in operating mode 3"):
        command(bus, "zero_force_on")


def test_what_nobody_does_in_time_is_not_done_later(config, monkeypatch) -> None:
    monkeypatch.setattr(powered, "ANSWER_S", 0.05)
    drive = Powered()
    with running(config, sources(config, drive)) as bus, pytest.raises(RequestError, match="not read at present"):
        command(bus, "zero_force_on")
    assert drive.asked[0][1].cancelled()


def test_what_is_not_configured_is_refused(config) -> None:
    with (
        running(config, sources(config, Powered())) as bus,
        pytest.raises(RequestError, match="gaze is not configured"),
    ):
        command(bus, "gaze_on")


def test_its_complaints_are_in_the_status(config) -> None:
    drive = Powered()
    drive.complaints = ("zero_force ended, torque off: it is too hot",)
    with running(config, sources(config, drive)) as bus:
        status = status_when(bus, lambda status: bool(status.health))
    assert drive.complaints[0] in status.health
