"""Zero-force of a real process, with dynamixel-sdk and a pseudo-terminal, and its end."""

from __future__ import annotations

import json
import math
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import warm

from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.wiring import open_joints
from bodyschema.drivers.dynamixel.emulator.arm import DynamixelArm
from bodyschema.drivers.dynamixel.emulator.servo import CURRENT_MODE, POSITION_MODE
from bodyschema.drivers.emulator.dry_run import DryRun
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError

HEARTBEAT_S = 0.5  # generous: emulator, driver and test share the machine with others
ANGLES = {"shoulder": 0.3, "elbow": -0.5}
LINK = '<link name="{name}">{inertial}</link>'
INERTIAL = (
    '<inertial><origin xyz="0.15 0 0"/><mass value="0.5"/>'
    '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial>'
)
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{xyz}"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="5" velocity="3"/></joint>"""
ROBOT = """[robot]
name = "arm"
urdf = "arm.urdf"
joints = ["shoulder", "elbow"]
marker_link = "forearm"
hold = "{hold}"
[camera]
parent_link = "base"
[drivers.dynamixel.buses.arm]
port = "{port}"
latency_ms = 20
[[drivers.dynamixel.servos]]
joint = "shoulder"
id = 1
model = "XM430-W350"
[[drivers.dynamixel.servos]]
joint = "elbow"
id = 2
model = "XM430-W350"
"""
ZERO_FORCE = f"""[drivers.dynamixel.zero_force]
heartbeat_ms = {1e3 * HEARTBEAT_S}
joints.shoulder = {{ current_limit_a = 2.0 }}
joints.elbow = {{ current_limit_a = 2.0 }}
"""


def write_robot(folder: Path, *, hold: str = "zero_force", tables: str = ZERO_FORCE, inertial: str = INERTIAL) -> Path:
    links = "".join(LINK.format(name=name, inertial=inertial) for name in ("base", "arm", "forearm"))
    joints = JOINT.format(name="shoulder", parent="base", child="arm", xyz="0 0 0.3")
    joints += JOINT.format(name="elbow", parent="arm", child="forearm", xyz="0.3 0 0")
    (folder / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
    file = folder / "robot.toml"
    file.write_text(ROBOT.format(hold=hold, port=folder / "bus") + tables)
    return file


@contextmanager
def emulator_of(file: Path, mode: int = CURRENT_MODE) -> Iterator[DryRun]:
    config = Config.load(file).tables.drivers.dynamixel
    assert config is not None
    angles = {joint: lambda _, q=q: q for joint, q in ANGLES.items()}
    with DryRun(DynamixelArm(config, angles), {"arm": file.parent / "bus"}) as emulator:
        for joint in ANGLES:
            servo = emulator.arm.servo(joint)
            servo["operating_mode"], servo["goal_current"] = mode, servo["current_limit"]
        yield emulator


@pytest.fixture
def emulator(tmp_path: Path) -> Iterator[DryRun]:
    with emulator_of(write_robot(tmp_path)) as emulator:
        yield emulator


class Floating:
    """A running `bodyschema watch joints --zero-force`."""

    def __init__(self, folder: Path) -> None:
        words = ["watch", "joints", "--json", "--zero-force", "--robot", "robot.toml"]
        ours, its = os.pipe()
        self._said, self._errors = os.fdopen(ours), tempfile.TemporaryFile("w+")  # noqa: SIM115
        with os.fdopen(its, "w") as out:
            self.process = warm.Child("-m", "bodyschema", *words, cwd=folder, stdout=out, stderr=self._errors)

    def __enter__(self) -> Floating:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.ended()
        self._said.close()
        self._errors.close()

    def until(self, true) -> dict:
        """Read what it says until that is true of it."""
        for line in self._said:
            said = json.loads(line)
            if true(said):
                return said
        raise AssertionError(self.errors())

    def ended(self) -> int:
        """Return its exit code."""
        for _ in self._said:
            pass
        return self.process.wait()

    def errors(self) -> str:
        """Return its stderr output."""
        self._errors.seek(0)
        return self._errors.read()


@pytest.fixture
def floating(emulator: DryRun, tmp_path: Path) -> Iterator[Floating]:
    def begun(said: dict) -> bool:
        return min(map(abs, currents(emulator, 0.0))) > 0.1 or has_ended(said)

    # On a full machine a heartbeat may come too late for the servos, which end it as they should: begin again.
    for _ in range(5):
        with Floating(tmp_path) as floating:
            if not has_ended(floating.until(begun)):
                yield floating
                return
    raise AssertionError("zero force ended itself five times")


def has_ended(said: dict) -> bool:
    return any("zero_force ended" in text for text in said["health"])


def torque(emulator: DryRun) -> list[int]:
    return [emulator.arm.servo(joint)["torque"] for joint in ANGLES]


def currents(emulator: DryRun, after_s: float) -> list[float]:
    return [emulator.arm.servo(joint).motor_current(time.monotonic() + after_s) for joint in ANGLES]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_with_torque_off(emulator, floating, number) -> None:
    floating.process.send_signal(number)
    assert floating.ended() == 0
    assert torque(emulator) == [0, 0]


def test_killed_process_leaves_no_current_after_heartbeat(emulator, floating) -> None:
    floating.process.kill()
    floating.ended()
    assert not any(currents(emulator, HEARTBEAT_S + 0.02))
    assert [emulator.arm.servo(joint)["watchdog"] for joint in ANGLES] == [-1, -1]


def test_unplugged_bus_loses_current_and_torque_stays_off(emulator, floating) -> None:
    emulator.shells["arm"].unplug()
    assert not any(currents(emulator, HEARTBEAT_S + 0.02))
    emulator.shells["arm"].plug_in()
    said = floating.until(lambda said: said["trouble"] is None and torque(emulator) == [0, 0] and said["health"])
    assert "zero_force ended, torque off" in said["health"][0]
    assert "bodyschema command zero_force_on" in said["health"][0]


def test_a_fault_of_a_servo_ends_it(emulator, floating) -> None:
    emulator.arm.servo("elbow").fail(0x20)
    said = floating.until(has_ended)
    assert torque(emulator) == [0, 0]
    assert floating.process.poll() is None
    assert any("'elbow'" in text for text in said["health"])


def test_another_mode_is_refused_with_the_command(tmp_path) -> None:
    with emulator_of(write_robot(tmp_path), POSITION_MODE) as emulator, Floating(tmp_path) as floating:
        assert floating.ended() == 1
        assert "bodyschema servos operating_mode=0 --joint shoulder" in " ".join(floating.errors().split())
        assert torque(emulator) == [0, 0]


# --- requirements on robot.toml


@pytest.mark.parametrize("hold", ["torque_free", "held"])
def test_hold_has_to_agree(tmp_path, hold) -> None:
    config = Config.load(write_robot(tmp_path, hold=hold))
    with pytest.raises(ConfigError, match=f'hold = "{hold}" in .robot. says otherwise to the diagnosis') as refused:
        open_joints(config, SystemClock())
    assert refused.value.line is not None


def test_zero_force_hold_without_driver_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match="but nothing bears the arm"):
        open_joints(Config.load(write_robot(tmp_path, tables="")), SystemClock())


def test_a_urdf_without_masses_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match="states no masses"):
        open_joints(Config.load(write_robot(tmp_path, inertial="")), SystemClock())


def test_currents_bear_the_weight_stated_in_urdf(emulator, floating) -> None:
    floating.until(lambda _: True)
    g, mass, lever, length = 9.80665, 0.5, 0.15, 0.3
    q1, q2 = ANGLES.values()
    elbow = mass * g * lever * math.cos(q1 + q2)
    shoulder = elbow + mass * g * (lever + length) * math.cos(q1)
    # A turn about y lowers the parts in front, so the holding torque is negative.
    expected = [-torque / (4.1 / 2.3) for torque in (shoulder, elbow)]
    assert currents(emulator, 0.0) == pytest.approx(expected, abs=0.01)
