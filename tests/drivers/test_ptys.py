"""Servos of each make and own encoders on a pseudo-terminal: real time, a real port."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from servo_arm import swing

from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.drivers.dynamixel.config import BusConfig as DynamixelBus
from bodyschema.drivers.dynamixel.config import DynamixelConfig
from bodyschema.drivers.dynamixel.emulator.chain import Chain as DynamixelChain
from bodyschema.drivers.dynamixel.emulator.servo import Servo as DynamixelServo
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME as DYNAMIXEL
from bodyschema.drivers.emulator.pty_shell import PtyShell
from bodyschema.drivers.feetech.config import BusConfig, FeetechConfig, ServoConfig
from bodyschema.drivers.feetech.emulator.arm import Chain
from bodyschema.drivers.feetech.emulator.servo import Servo
from bodyschema.drivers.feetech.joints import FeetechJoints
from bodyschema.drivers.feetech.models import BY_NAME
from bodyschema.drivers.serial_lines.config import EncoderConfig, SerialLinesConfig
from bodyschema.drivers.serial_lines.emulator.board import EncoderBoard
from bodyschema.drivers.serial_lines.joints import SerialLineJoints
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.records import JointReading

LIMIT_S = 300.0
IDS = range(1, 7)
NAMES = [f"joint{id}" for id in IDS]
LIMITS = [(-2.0, 2.0)] * 6
Make = Callable[[Path], Any]


@contextmanager
def dynamixel(folder: Path) -> Iterator[tuple[PtyShell, Callable[[], DynamixelJoints]]]:
    model = DYNAMIXEL["XM430-W350"]
    chain = DynamixelChain(DynamixelServo(model, id, swing(id), return_delay_s=0, booted_s=id * 0.1234) for id in IDS)
    entries = tuple(ServoConfig(name, id, "XM430-W350") for name, id in zip(NAMES, IDS, strict=True))
    with PtyShell(chain, folder / "bus") as shell:
        config = DynamixelConfig({"arm": DynamixelBus(str(shell.link))}, entries)
        yield shell, lambda: DynamixelJoints(config, NAMES, SystemClock(), limits=LIMITS)


@contextmanager
def feetech(folder: Path) -> Iterator[tuple[PtyShell, Callable[[], FeetechJoints]]]:
    chain = Chain(Servo(BY_NAME["STS3215"], id, swing(id), return_delay_s=0) for id in IDS)
    entries = tuple(ServoConfig(name, id, "STS3215") for name, id in zip(NAMES, IDS, strict=True))
    with PtyShell(chain, folder / "bus") as shell:
        config = FeetechConfig({"arm": BusConfig(str(shell.link))}, entries)
        yield shell, lambda: FeetechJoints(config, NAMES, SystemClock(), limits=LIMITS)


@contextmanager
def encoders(folder: Path) -> Iterator[tuple[PtyShell, Callable[[], SerialLineJoints]]]:
    angles = {name: (4096, swing(id)) for name, id in zip(NAMES, IDS, strict=True)}
    board = EncoderBoard(angles, rate_hz=100.0, begun_s=time.monotonic())
    with PtyShell(board, folder / "bus") as shell:
        config = SerialLinesConfig(str(shell.link), tuple(EncoderConfig(name) for name in NAMES))
        yield shell, lambda: SerialLineJoints(config, NAMES, SystemClock(), limits=LIMITS)


pytestmark = pytest.mark.usefixtures("patient_host", "silence_is_no_loss")
EACH = pytest.mark.parametrize("make", [dynamixel, feetech, encoders])


@pytest.fixture
def silence_is_no_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """Emulator and driver share this process: on a busy machine the emulator itself may be silent for a while."""
    monkeypatch.setattr("bodyschema.drivers.servos.joints.LOST_AFTER_S", LIMIT_S)


def wait_for_reading(source: Any) -> JointReading:
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        if (reading := source.read(0.1)) is not None:
            return reading
    raise AssertionError("no reading came")


@contextmanager
def patiently(source: Any) -> Iterator[Any]:
    """Open `source`, also where a busy machine lets the emulator answer the first attempts too late."""
    deadline = time.monotonic() + LIMIT_S
    with ExitStack() as stack:
        opened = None
        while opened is None:
            try:
                opened = stack.enter_context(source)
            except SourceLost:
                if time.monotonic() > deadline:
                    raise
        yield opened


@EACH
def test_readings_are_right_with_wire_time(make: Make, tmp_path) -> None:
    with make(tmp_path) as (_, driver), patiently(driver()) as joints:
        readings = [wait_for_reading(joints) for _ in range(50)]
    off = [np.abs(reading.q - [swing(id)(reading.t) for id in IDS]).max() for reading in readings]
    assert np.median(off) < 0.02  # on a busy machine the time of a single one may be off


@EACH
def test_open_port_refuses_a_second_driver(make: Make, tmp_path) -> None:
    with make(tmp_path) as (_, driver), patiently(driver()) as joints:
        wait_for_reading(joints)
        with pytest.raises(SourceError, match="is in use by another program"):
            driver().__enter__()


@EACH
def test_unplugged_port_is_reported_once_and_recovers(make: Make, tmp_path, caplog) -> None:
    with make(tmp_path) as (shell, driver):
        joints = driver()
        reconnecting = ReconnectingSource(joints, "the encoders", SystemClock())
        with caplog.at_level(logging.WARNING), patiently(reconnecting) as source:
            before = wait_for_reading(source)
            caplog.clear()  # on a busy machine the emulator may have been silent before
            losses = source.losses
            shell.unplug()
            for _ in range(20):
                source.read(0.05)
            told, losses = list(caplog.messages), source.losses - losses
            assert source.trouble is not None
            shell.plug_in()
            after = wait_for_reading(source)
    assert len(told) == losses == 1
    assert "is gone" in told[0]
    assert joints.epoch > 1  # on a busy machine the first attempt may find nobody
    assert after.t > before.t


def test_long_unread_board_is_readable_after_replug(tmp_path) -> None:
    angles = {name: (4096, swing(id)) for name, id in zip(NAMES, IDS, strict=True)}
    board = EncoderBoard(angles, rate_hz=100.0, begun_s=time.monotonic() - 60.0)  # a minute to say at once
    with PtyShell(board, tmp_path / "bus") as shell:
        config = SerialLinesConfig(str(shell.link), tuple(EncoderConfig(name) for name in NAMES))
        deadline = time.monotonic() + LIMIT_S
        while board.speaks_at < time.monotonic() - 1.0:
            assert time.monotonic() < deadline
        shell.unplug()
        shell.plug_in()
        joints = SerialLineJoints(config, NAMES, SystemClock(), limits=LIMITS)
        while not opened(joints):
            assert time.monotonic() < deadline


def opened(joints: SerialLineJoints) -> bool:
    """Read once; return False where a busy machine kept the lines so long that their times are unknown."""
    try:
        with joints:
            wait_for_reading(joints)
    except SourceLost as lost:
        if "delayed lines" not in str(lost):
            raise
        return False
    return True
