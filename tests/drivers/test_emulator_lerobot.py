"""LeRobot's own bus classes, unmodified, on emulated servos: what they read and write is what this project says.

LeRobot brings torch, of which the buses use nothing. So it may be installed without what it depends on:
pip install --no-deps lerobot feetech-servo-sdk deepdiff orderly-set cachebox tqdm
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from bodyschema.drivers.dynamixel.emulator.chain import Chain as DynamixelChain
from bodyschema.drivers.dynamixel.emulator.servo import Servo as DynamixelServo
from bodyschema.drivers.dynamixel.models import BY_NAME as DYNAMIXEL
from bodyschema.drivers.emulator.pty_shell import PtyShell
from bodyschema.drivers.feetech.emulator.arm import Chain as FeetechChain
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.drivers.feetech.models import BY_NAME as FEETECH
from bodyschema.robot.lerobot import ARMS, Make, MotorCalibration

REMEDY = "no LeRobot; to run it: pip install --no-deps lerobot feetech-servo-sdk deepdiff orderly-set cachebox tqdm"
CALIBRATION = {
    name: MotorCalibration(k + 1, 0, (1021, -87, 0, -2040, 512, 300)[k], 743 + 10 * k, 3460 - 20 * k)
    for k, name in enumerate(ARMS["so101"].models)
}
SHAFT_RAD = (0.3, -0.5, 0.7, 0.2, -0.4, 0.1)
UNITS: dict[str, Any] = {"degrees": "DEGREES", "range_m100_100": "RANGE_M100_100", "range_0_100": "RANGE_0_100"}

pytestmark = pytest.mark.usefixtures("patient_host")


@pytest.fixture(scope="module")
def lerobot() -> Iterator[ModuleType]:
    """Return `lerobot.motors`; of `lerobot.utils.utils`, which imports torch, its buses use what asks for a key."""
    pytest.importorskip("lerobot", reason=REMEDY)
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(sys.modules, "lerobot.utils.utils", MagicMock())
        for make in ("feetech", "dynamixel"):
            pytest.importorskip(f"lerobot.motors.{make}", reason=REMEDY)
        yield importlib.import_module("lerobot.motors")


def patiently(call: Callable[[], Any]) -> Any:
    """Call again where an answer came too late for LeRobot, which waits 34 ms: this machine may be busy."""
    for _ in range(20):
        with suppress(ConnectionError, RuntimeError):
            return call()
    return call()


def chain(make: Make, arm: str) -> Any:
    servo, models, chained = {
        "feetech": (FeetechServo, FEETECH, FeetechChain),
        "dynamixel": (DynamixelServo, DYNAMIXEL, DynamixelChain),
    }[make]
    told = zip(ARMS[arm].models.values(), SHAFT_RAD, strict=True)
    return chained(servo(models[model], k + 1, lambda _, a=a: a, return_delay_s=0) for k, (model, a) in enumerate(told))


@contextmanager
def connected(lerobot: ModuleType, arm: str, unit: str, folder: Path) -> Iterator[tuple[Any, Any]]:
    """Yield LeRobot's bus, connected to an emulated arm with CALIBRATION in its servos, and the emulated chain."""
    make = ARMS[arm].make
    servos = chain(make, arm)
    kind = {"feetech": "FeetechMotorsBus", "dynamixel": "DynamixelMotorsBus"}[make]
    mode = getattr(lerobot.MotorNormMode, UNITS[unit])
    models = {name: model.lower() for name, model in ARMS[arm].models.items()}
    motors = {name: lerobot.Motor(k + 1, model, mode) for k, (name, model) in enumerate(models.items())}
    calibration = {
        name: lerobot.MotorCalibration(m.id, m.drive_mode, m.homing_offset, m.range_min, m.range_max)
        for name, m in CALIBRATION.items()
    }
    with PtyShell(servos, folder / "bus") as shell:
        bus = getattr(importlib.import_module(f"lerobot.motors.{make}"), kind)(str(shell.link), motors, calibration)
        bus.connect(handshake=False)
        try:
            patiently(bus._handshake)
            patiently(lambda: bus.write_calibration(calibration))
            yield bus, servos
        finally:
            bus.disconnect(disable_torque=False)


def told(arm: str) -> list[tuple[bytes, bytes]]:
    """Return what LeRobot 0.4.4 sent to an emulated arm, and the answers that it accepted."""
    lines = (Path(__file__).parent / "lerobot_bytes.txt").read_text().partition(f"[{arm}]\n")[2].partition("[")[0]
    return [(bytes.fromhex(line.split()[0]), bytes.fromhex("".join(line.split()[1:]))) for line in lines.splitlines()]


@pytest.mark.parametrize("arm", ["so101", "koch"])
def test_emulator_answers_lerobot_packets_as_recorded(arm: str) -> None:
    servos, now_s = chain(ARMS[arm].make, arm), 0.0
    for sent, answer in told(arm):
        now_s += 0.1
        assert b"".join(reply.data for reply in servos.send(sent, now_s, 1_000_000)) == answer
    assert [servo["homing_offset"] for servo in servos.servos] == [m.homing_offset for m in CALIBRATION.values()]


@pytest.mark.parametrize("unit", ["degrees", "range_m100_100", "range_0_100"])
@pytest.mark.parametrize("arm", ["so101", "koch"])
def test_lerobot_reads_values_computed_from_its_calibration(lerobot, arm: str, unit: str, tmp_path: Path) -> None:
    with connected(lerobot, arm, unit, tmp_path) as (bus, _):
        assert patiently(lambda: bus.is_calibrated)
        read = bus.sync_read("Present_Position", num_retry=20)
        ticks = bus.sync_read("Present_Position", normalize=False, num_retry=20)
    expected = {
        name: float(motor.readings(np.array(float(ticks[name])), unit, ARMS[arm].make))
        for name, motor in CALIBRATION.items()
    }
    assert read == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("arm", ["so101", "koch"])
def test_corrected_offsets_move_lerobots_readings_by_the_offset(lerobot, arm: str, tmp_path: Path) -> None:
    with connected(lerobot, arm, "degrees", tmp_path) as (bus, _):
        before = bus.sync_read("Present_Position", num_retry=20)
        for motor in ("shoulder_lift", "elbow_flex"):
            changed = CALIBRATION[motor].moved(round(math.radians(2.0) * 4096 / (2 * math.pi)), ARMS[arm].make)
            bus.calibration[motor].homing_offset = changed.homing_offset
        patiently(lambda: bus.write_calibration(bus.calibration))
        after = bus.sync_read("Present_Position", num_retry=20)
    moved = {name: after[name] - before[name] for name in before}
    expected = {name: 2.0 if name in ("shoulder_lift", "elbow_flex") else 0.0 for name in before}
    assert moved == pytest.approx(expected, abs=0.06)
