"""Checks of ports and servos: findings and the commands that fix them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from bodyschema.drivers import checks
from bodyschema.drivers.checks import Check, holders, port_checks
from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.arm import DynamixelArm
from bodyschema.drivers.dynamixel.joints import DYNAMIXEL
from bodyschema.drivers.emulator.dry_run import DryRun
from bodyschema.drivers.emulator.faults import FaultSpec
from bodyschema.drivers.feetech.config import BusConfig as FeetechBus
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.feetech.emulator.arm import FeetechArm
from bodyschema.drivers.feetech.joints import FEETECH
from bodyschema.drivers.servos.checks import servo_checks
from bodyschema.drivers.servos.joints import open_serial
from bodyschema.interfaces.clock import SystemClock

JOINTS = ("waist", "elbow")
CONFIG = DynamixelConfig(
    {"arm": BusConfig("elsewhere", latency_ms=20.0)},
    (ServoConfig("waist", 1, "XM430-W350"), ServoConfig("elbow", 2, "MX-28")),
)
FEETECH_CONFIG = FeetechConfig(
    {"arm": FeetechBus("elsewhere", latency_ms=20.0)},
    (ServoConfig("waist", 1, "STS3215"), ServoConfig("elbow", 2, "SCS0009")),
)
# Of each make: how to build its emulator, how to open it, the model at the elbow, and how an
# overloaded servo is fixed.
MAKES = {
    "Dynamixel": (
        DynamixelArm, CONFIG, DYNAMIXEL, open_serial, "MX-28",
        "free the joint, then switch its supply off and on",
    ),
    "Feetech": (
        FeetechArm, FEETECH_CONFIG, FEETECH, open_serial, "SCS0009",
        "free the joint, then switch its supply off and on",
    ),
}  # fmt: skip
EACH = pytest.mark.parametrize("make", MAKES)


class Machine:
    """A fake file system with the entries that the checks read."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.port = root / "dev" / "ttyUSB0"
        self.by_id = root / "dev" / "serial" / "by-id" / "usb-FTDI-if00"
        self.by_id.parent.mkdir(parents=True)
        self.port.touch()
        self.by_id.symlink_to(self.port)

    def process(self, pid: int, command: str, *opened: object) -> None:
        folder = self.root / "proc" / str(pid) / "fd"
        folder.mkdir(parents=True)
        (folder.parent / "cmdline").write_bytes(command.replace(" ", "\0").encode())
        for number, target in enumerate(opened):
            (folder / str(number)).symlink_to(str(target))

    def latency(self, ms: int) -> None:
        file = self.root / "sys/bus/usb-serial/devices/ttyUSB0/latency_timer"
        file.parent.mkdir(parents=True)
        file.write_text(f"{ms}\n")

    def checks(self, port: Path | None = None) -> list[Check]:
        return list(port_checks("arm", str(self.by_id if port is None else port), self.root))


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_free_port_is_ok(machine) -> None:
    assert [check.state for check in machine.checks()] == ["ok"]


def test_missing_port_fix_names_the_existing_port(machine) -> None:
    (check,) = machine.checks(machine.root / "dev" / "gone")
    assert check.state == "wrong"
    assert f'set port = "{machine.by_id}"' in check.fix


def test_busy_port_fix_kills_its_holder(machine) -> None:
    machine.process(4711, "wizard --fast", "/dev/null", machine.port)
    (check,) = machine.checks()
    assert (check.state, check.fix) == ("wrong", "kill 4711")
    assert check.said.endswith("process 4711: wizard --fast")


def test_the_running_sampler_may_have_the_port(machine) -> None:
    machine.process(4711, "bodyschema run sampler", machine.port)
    (check,) = port_checks("arm", str(machine.by_id), machine.root, ours=[4711])
    assert (check.state, check.said.endswith("the running sampler has it open")) == ("ok", True)


def test_pseudo_terminal_master_does_not_count_as_holder(machine) -> None:
    machine.process(1, "emulator", "/dev/ptmx", "/dev/pts/7")
    machine.process(2, "reader", "/dev/pts/7")
    assert [holder.pid for holder in holders("/dev/pts/7", machine.root)] == [2]


def test_this_process_is_no_other_one(machine) -> None:
    machine.process(os.getpid(), "python", machine.port)
    assert holders(str(machine.port), machine.root) == []


def test_slow_latency_timer_warning_names_the_udev_fix(machine) -> None:
    machine.latency(16)
    check = machine.checks()[-1]
    assert (check.subject, check.state) == ("latency timer", "warning")
    assert "up to 16 ms" in check.said
    assert check.fix.startswith("bodyschema install udev")


def test_a_latency_timer_of_1_ms_is_ok(machine) -> None:
    machine.latency(1)
    assert machine.checks()[-1].state == "ok"


def test_unstable_port_name_fix_gives_the_stable_one(machine) -> None:
    check = machine.checks(machine.port)[-1]
    assert (check.state, check.fix) == ("warning", f'set port = "{machine.by_id}" in robot.toml')


def test_inaccessible_port_fix_adds_user_to_group(machine, monkeypatch) -> None:
    monkeypatch.setattr(checks.os, "access", lambda *_: False)
    monkeypatch.setattr(checks.os, "getgroups", list)
    check = machine.checks()[0]
    assert check.state == "wrong"
    assert check.fix.startswith("sudo usermod -aG ")


# --- emulated servos


class Told:
    """Doctor's findings about emulated servos."""

    def __init__(self, make: str, tmp_path: Path, *faults: str, delay_s: float = 0.0, read_s: float = 0.2) -> None:
        arm_of, config, the_make, open_port, *_ = MAKES[make]
        asked = [FaultSpec.parsed(fault, JOINTS, arm_of.kinds) for fault in faults]
        self.arm = arm_of(config, dict.fromkeys(JOINTS, lambda _: 0.2), faults=asked, return_delay_s=delay_s)
        with DryRun(self.arm, {"arm": tmp_path / "bus"}) as emulator:
            self.checks = list(servo_checks(the_make, emulator.config, SystemClock(), open_port, read_s=read_s))

    def of(self, subject: str) -> list[Check]:
        return [check for check in self.checks if check.subject == subject]


@EACH
def test_healthy_servos_are_reported_with_their_rate(make, tmp_path) -> None:
    told = Told(make, tmp_path)
    if told.of("rate")[0].state == "wrong":  # on a full machine the emulator may not answer in so short a time
        told = Told(make, tmp_path, read_s=20.0)
    assert told.of("servos") == [Check("servos", "ok", "all 2 answer, each of the model that robot.toml names")]
    assert "readings/s are possible (250 wanted)" in told.of("rate")[0].said


@EACH
def test_a_missing_servo_is_wrong(make, tmp_path) -> None:
    check = Told(make, tmp_path, "baud@elbow").of("servos")[0]
    assert (check.state, check.said) == ("wrong", f"joint elbow (ID 2, {MAKES[make][4]}): no answer")


@EACH
@pytest.mark.parametrize("joint", JOINTS)
def test_overload_alert_is_wrong_with_its_remedy(make, tmp_path, joint) -> None:
    check = Told(make, tmp_path, f"overload@{joint}").of("servos")[1]
    assert (check.state, check.said) == ("wrong", f"joint {joint} (ID {JOINTS.index(joint) + 1}): it is overloaded")
    assert check.fix == MAKES[make][5]


@EACH
def test_slow_answers_are_reported_with_the_register(make, tmp_path) -> None:
    check = Told(make, tmp_path, delay_s=500e-6).of("servos")[1]
    assert (check.state, check.fix) == ("warning", "bodyschema servos return_delay=0 --bus arm")


@EACH
def test_errors_are_counted_by_kind(make, tmp_path) -> None:
    check = Told(make, tmp_path, "checksum=0.3").of("errors")[0]
    assert check.state == "warning"
    assert "× a garbled answer" in check.said


@EACH
def test_the_doctor_leaves_torque_as_it_is(make, tmp_path) -> None:
    told = Told(make, tmp_path, "torque@waist")
    assert told.arm.servo("waist")["torque"] == 1
    assert "joint waist holds its place" in told.of("servos")[1].said


@EACH
def test_unopenable_port_is_one_finding(make) -> None:
    _, config, the_make, open_port, *_ = MAKES[make]
    (check,) = servo_checks(the_make, config, SystemClock(), open_port)
    assert (check.state, "elsewhere is not there" in check.said) == ("wrong", True)
