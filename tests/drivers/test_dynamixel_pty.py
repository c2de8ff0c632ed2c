"""The driver with the emulator on a pseudo-terminal: real time, a real port."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from servo_arm import swing

from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.emulator.pty_shell import PtyShell
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.records import JointReading

SIX = range(1, 7)
LIMIT_S = 300.0


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, patient_host: None):
    # Emulator and driver share this process: on a busy machine the emulator itself may be silent for a while.
    monkeypatch.setattr("bodyschema.drivers.servos.joints.LOST_AFTER_S", LIMIT_S)
    servos = [Servo(BY_NAME["XM430-W350"], id, swing(id), return_delay_s=0, booted_s=id * 0.1234) for id in SIX]
    with PtyShell(Chain(servos), tmp_path / "bus") as shell:
        yield shell


def driver(shell: PtyShell, **bus) -> DynamixelJoints:
    entries = tuple(ServoConfig(f"joint{id}", id, "XM430-W350") for id in SIX)
    config = DynamixelConfig({"arm": BusConfig(str(shell.link), **bus)}, entries)
    return DynamixelJoints(config, [entry.joint for entry in entries], SystemClock(), limits=[(-2.0, 2.0)] * 6)


def wait_for_reading(source) -> JointReading:
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        if (reading := source.read(0.1)) is not None:
            return reading
    raise AssertionError("no reading came")


@pytest.mark.parametrize("fast", ["auto", "never"])
def test_readings_are_right_with_wire_time(shell, fast) -> None:
    with driver(shell, fast_sync_read=fast) as joints:
        readings = [wait_for_reading(joints) for _ in range(50)]
    off = [np.abs(reading.q - [swing(id)(reading.t) for id in SIX]).max() for reading in readings]
    assert np.median(off) < 0.02  # on a busy machine the time of a single one may be off


def test_undelayed_reading_time_matches_the_sampling(shell) -> None:
    off = []
    with driver(shell) as joints:
        for _ in range(100):
            reading = wait_for_reading(joints)
            off.append(abs(reading.t - np.mean([sampling.t for sampling in shell.device.samplings.values()])))
    # A full machine holds up nearly all of them, and a time that is wrong is wrong for all.
    assert min(off) < 0.5e-3


def test_waiting_costs_little_of_the_processor(shell) -> None:
    with driver(shell) as joints:
        wait_for_reading(joints)
        begin, used = time.monotonic(), time.thread_time()
        for _ in range(200):
            wait_for_reading(joints)
        assert time.thread_time() - used < 0.3 * (time.monotonic() - begin)
