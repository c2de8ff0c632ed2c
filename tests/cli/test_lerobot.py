"""Arms of LeRobot: its units and files, its servos at the bytes, a leader and a follower on two ports."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from bodyschema.cli.commands.options import LeRobotOptions
from bodyschema.cli.hardware.lerobot_robot import CorrectedCalibration
from bodyschema.cli.main import command_line
from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.daemon.wiring.wiring import open_joints
from bodyschema.drivers.dynamixel.emulator.servo import Servo as DynamixelServo
from bodyschema.drivers.dynamixel.models import BY_NAME as DYNAMIXEL
from bodyschema.drivers.emulator.pty_shell import PtyShell
from bodyschema.drivers.feetech.emulator.arm import Chain
from bodyschema.drivers.feetech.emulator.servo import Servo
from bodyschema.drivers.feetech.models import BY_NAME
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError
from bodyschema.recordings.recording import Recording
from bodyschema.robot.lerobot import ARMS, JointServo, MotorCalibration, corrections, read_calibration

SO101 = Path(__file__).parents[2] / "examples" / "so101"
JOINTS = ARMS["so101"].joints
POSE_RAD = dict(zip(ARMS["so101"].models, (0.3, -0.5, 0.7, 0.2, -1.0, 0.4), strict=True))
# Of LeRobot 0.3.3's own classes: FeetechMotorsBus and DynamixelMotorsBus `_normalize` at these ticks, for a range of
# 812 … 3207.
READ_BY_LEROBOT = [
    ("feetech", "degrees", 0, 700, -115.12087912087912),
    ("feetech", "degrees", 1, 3300, 113.45054945054945),
    ("feetech", "range_m100_100", 0, 1500, -42.54697286012526),
    ("feetech", "range_m100_100", 1, 1500, 42.54697286012526),
    ("feetech", "range_0_100", 1, 1500, 71.27348643006263),
    ("dynamixel", "range_m100_100", 1, 1500, -42.54697286012526),
    ("feetech", "range_m100_100", 0, 3300, 100.0),
]

# The emulated arms are on real ports.
pytestmark = pytest.mark.usefixtures("patient_host")


def config(*arguments: object) -> None:
    words = ["init", "--lerobot", "so101", *arguments]
    if "--urdf" not in words:
        words += ["--urdf", SO101 / "so101.urdf"]
    command_line("config")(list(map(str, words)), exit_on_error=False, result_action="return_value")


def robot_of(arm: str, file: Path, port: object = "/dev/ttyACM0") -> Config:
    config("--calibration", SO101 / f"{arm}.json", "--port", port, "--robot", file)
    return Config.load(file, {})


def servos_of(motors: dict[str, MotorCalibration]) -> list[Servo]:
    """Return servos with LeRobot's offsets in their EEPROM, on an arm that stands in POSE_RAD."""
    servos: list[Servo] = []
    for name, motor in motors.items():
        encoder = motor.homing_offset + motor.middle + POSE_RAD[name] * 4096 / (2 * math.pi)
        shaft = (encoder - 2048) * 2 * math.pi / 4096
        servos.append(Servo(BY_NAME["STS3215"], motor.id, lambda _, shaft=shaft: shaft, return_delay_s=0))
        servos[-1]["homing_offset"] = motor.homing_offset
    return servos


@contextmanager
def both_arms(folder: Path) -> Iterator[dict[str, Path]]:
    with ExitStack() as stack:
        links = {arm: folder / f"port_{arm}" for arm in ("leader", "follower")}
        for arm, link in links.items():
            motors = read_calibration(SO101 / f"{arm}.json")
            stack.enter_context(PtyShell(Chain(servos_of(motors)), link))
        yield links


def read(config: Config) -> np.ndarray:
    clock = SystemClock()
    with ReconnectingSource(open_joints(config, clock), "the arm", clock) as joints:
        for _ in range(60):
            if (reading := joints.read(1.0)) is not None:
                return reading.q
    raise AssertionError("no reading came")


@pytest.mark.parametrize(("make", "unit", "drive_mode", "ticks", "expected"), READ_BY_LEROBOT)
def test_readings_are_those_of_lerobot(make, unit, drive_mode, ticks, expected) -> None:
    motor = MotorCalibration(1, drive_mode, 0, 812, 3207)
    assert motor.readings(np.array(float(ticks)), unit, make) == pytest.approx(expected, abs=1e-11)


@pytest.mark.parametrize("unit", ["degrees", "range_m100_100", "range_0_100"])
@pytest.mark.parametrize("drive_mode", [0, 1])
def test_ticks_come_back_from_readings(unit, drive_mode) -> None:
    motor, ticks = MotorCalibration(1, drive_mode, 5, 812, 3207), np.arange(812.0, 3208.0)
    assert motor.ticks(motor.readings(ticks, unit, "feetech"), unit, "feetech") == pytest.approx(ticks, abs=1e-9)


def test_leader_and_follower_read_true_angles(tmp_path) -> None:
    with both_arms(tmp_path) as ports:
        for arm, port in ports.items():
            q = read(robot_of(arm, tmp_path / f"{arm}.toml", port))
            assert np.degrees(q) == pytest.approx([math.degrees(POSE_RAD[name]) for name in JOINTS], abs=0.05)


def test_two_arms_on_two_ports_are_asked_about(tmp_path) -> None:
    told = r"such arms are on .*leader and .*follower"
    with both_arms(tmp_path) as ports, pytest.raises(ConfigError, match=told):
        config("--calibration", SO101 / "leader.json", *(f"--port={port}" for port in ports.values()))


def test_joints_of_another_urdf_are_named(tmp_path) -> None:
    desk_arm = SO101.parent / "desk_arm" / "desk_arm.urdf"
    with pytest.raises(ConfigError, match=r"has no joint shoulder_pan.*; it has base_yaw"):
        config("--urdf", desk_arm, "--calibration", SO101 / "leader.json", "--port", "x", "--robot", tmp_path / "r")


@pytest.mark.parametrize(("marker", "expected"), [("--tag-mm=49.8", 0.0498), ("--ball-mm=40", 0.02)])
def test_one_webcam_and_its_marker_need_no_editing(tmp_path, marker, expected) -> None:
    words = ["--calibration", SO101 / "follower.json", "--port", "x", "--webcam", "/dev/v4l/by-id/cam", marker]
    config(*words, "--robot", tmp_path / "robot.toml")
    found = Config.load(tmp_path / "robot.toml", {})
    vision = found.tables.vision
    assert found.robot.camera.eyes == 1
    assert vision.cameras.one.device == "/dev/v4l/by-id/cam"
    assert "CHECK: " not in (tmp_path / "robot.toml").read_text()
    assert (vision.tag.side_m if vision.marker == "tag" else vision.radius_m) == expected


def test_any_webcam_without_one_says_so(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.daemon.wiring.wiring.connected_cameras", lambda: ())
    with pytest.raises(ConfigError, match="--webcam any: no camera is plugged in"):
        config("--calibration", SO101 / "follower.json", "--port", "x", "--webcam", "any", "--robot", tmp_path / "r")


def test_zero_is_the_middle_of_the_recorded_range(tmp_path) -> None:
    servos = robot_of("follower", tmp_path / "robot.toml").tables.drivers.feetech.servos
    assert servos[0].zero_ticks == (743 + 3460) / 2


@pytest.mark.parametrize("arm", ["leader", "follower"])
def test_written_offsets_correct_the_readings(arm, tmp_path) -> None:
    robot = robot_of(arm, tmp_path / "robot.toml", tmp_path / "bus")
    offsets = dict(zip(JOINTS, np.radians([0.0, 2.0, -3.5, 1.25, 0.0]), strict=True))
    corrected = CorrectedCalibration.of(robot, SO101 / f"{arm}.json", offsets)
    servos = servos_of(read_calibration(SO101 / f"{arm}.json"))
    for servo, motor in zip(servos, corrected.motors.values(), strict=True):
        servo["homing_offset"] = motor.homing_offset  # as LeRobot writes it
    with PtyShell(Chain(servos), tmp_path / "bus"):
        q = read(robot)
    expected = [math.degrees(POSE_RAD[name] + offsets[name]) for name in JOINTS]
    assert np.degrees(q) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("inverted", [0, 1])
def test_dynamixel_offsets_correct_the_readings(inverted, tmp_path) -> None:
    """Check an elbow of a Koch leader, which LeRobot sets to count the other way in the servo itself."""
    before = MotorCalibration(3, inverted, -512, 900, 3100)
    servo = JointServo("elbow_flex", "dynamixel", 1, before.middle)
    (change,) = corrections({"elbow_flex": before}, [servo], {"elbow_flex": math.radians(3.0)})
    arm = DynamixelServo(DYNAMIXEL["XL330-M077"], 3, lambda _: 0.4, return_delay_s=0)
    arm["drive_mode"], readings = inverted, []
    for motor in (change.before, change.after):
        arm["homing_offset"] = motor.homing_offset
        readings.append(servo.angles(np.array(float(arm.position(0.0)))))
    assert math.degrees(readings[1] - readings[0]) == pytest.approx(3.0, abs=0.05)


def test_offsets_stay_within_the_servo_s_range() -> None:
    moved = [MotorCalibration(1, 0, offset, 0, 4095).moved(100, "feetech").homing_offset for offset in (-2040, 0, 7)]
    assert moved == [-2040 - 100 + 4096, -100, -93]


def planted(file: Path, robot: Config) -> None:
    """Write a recording of an arm whose shoulder_lift reads 2° too little."""
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.robot.lower, robot.robot.upper, (150, 5))
    true = q + np.radians([0, 2.0, 0, 0, 0])
    x = robot.robot.chain.positions(true) + rng.normal(scale=1e-4, size=(150, 3))
    Recording(joints=robot.robot.joints, q=q, x=x).write_csv(file)


def calibrate(*arguments: object) -> None:
    command_line("calibrate")(["calibrate", *map(str, arguments)], exit_on_error=False, result_action="return_value")


def test_calibrate_shows_the_difference_and_writes_nothing(tmp_path, capsys) -> None:
    mine = tmp_path / "follower.json"
    shutil.copy(SO101 / "follower.json", mine)
    planted(tmp_path / "r.csv", robot_of("follower", tmp_path / "robot.toml"))
    calibrate(tmp_path / "r.csv", "--lerobot", mine)
    assert "shoulder_lift  homing_offset 1021 → 99" in " ".join(capsys.readouterr().out.split("\n")).replace("   ", " ")
    assert mine.read_bytes() == (SO101 / "follower.json").read_bytes()


@pytest.mark.parametrize(("arm", "warned"), [("follower", False), ("leader", True)])
def test_calibration_with_other_zeros_is_reported(arm, warned, tmp_path, capsys) -> None:
    planted(tmp_path / "r.csv", robot_of("follower", tmp_path / "robot.toml"))
    calibrate(tmp_path / "r.csv", "--lerobot", SO101 / f"{arm}.json")
    said = capsys.readouterr().out
    assert ("robot.toml has other zeros than leader.json: in the middle of its range shoulder_pan" in said) == warned


@pytest.mark.parametrize("command", ["calibrate", "diagnose"])
def test_missing_calibration_fails_before_recording_is_read(command, tmp_path) -> None:
    robot_of("follower", tmp_path / "robot.toml")
    (tmp_path / "r.csv").write_text("unread")
    words = [command, str(tmp_path / "r.csv"), "--lerobot", str(tmp_path / "none.json")]
    with pytest.raises(ConfigError, match=r"none\.json"):
        command_line(command)(words, exit_on_error=False, result_action="return_value")


def test_calibrate_writes_and_keeps_the_old_file(tmp_path) -> None:
    mine = tmp_path / "follower.json"
    shutil.copy(SO101 / "follower.json", mine)
    planted(tmp_path / "r.csv", robot_of("follower", tmp_path / "robot.toml"))
    calibrate(tmp_path / "r.csv", "--lerobot", mine, "--write")
    found = read_calibration(mine)["shoulder_lift"].homing_offset
    assert found == pytest.approx(1021 - 2.0 * 4096 / 360, abs=3)
    assert (tmp_path / "follower.json.before").read_bytes() == (SO101 / "follower.json").read_bytes()


def test_offsets_of_one_recording_are_written_once(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    mine, file = Path("follower.json"), Path("r.csv")
    shutil.copy(SO101 / "follower.json", mine)
    robot, offsets = robot_of("follower", Path("robot.toml")), {"shoulder_lift": math.radians(2.0)}
    planted(file, robot)
    LeRobotOptions(mine, True).lines(robot, offsets, file)
    once = mine.read_bytes()
    told = (
        "follower.json already has the offsets of r.csv in it (follower.json.before is the file without them). Record "
        "again with the new calibration; or delete follower.json.recordings to write all the same."
    )
    assert LeRobotOptions(mine, False).lines(robot, offsets, file) == [told]
    capsys.readouterr()
    calibrate(file, "--lerobot", mine, "--write")
    assert f"{told}\n" in capsys.readouterr().out
    assert mine.read_bytes() == once
    assert not Path("follower.json.before2").exists()
    Path("follower.json.recordings").unlink()
    LeRobotOptions(mine, True).lines(robot, offsets, file)
    assert Path("follower.json.before2").read_bytes() == once != mine.read_bytes()


def test_a_second_recording_is_noted_beside_the_first(tmp_path) -> None:
    mine = tmp_path / "follower.json"
    shutil.copy(SO101 / "follower.json", mine)
    robot = robot_of("follower", tmp_path / "robot.toml")
    corrected = CorrectedCalibration.of(robot, mine, {"elbow_flex": math.radians(1.0)})
    files = [tmp_path / name for name in ("first.csv", "second.csv", "third.csv")]
    for file in files:
        file.write_text(file.name)
    for file in files[:2]:
        corrected.write(file)
    corrected.write(tmp_path)  # a folder is not noted
    assert [bool(corrected.already_written(file)) for file in (*files, tmp_path, None)] == [
        True,
        True,
        False,
        False,
        False,
    ]
    assert "follower.json.before2" in corrected.already_written(files[1])[0]
    (tmp_path / "first.csv-wal").write_text("later samples of a store")
    assert corrected.already_written(files[0]) == []


def test_calibrations_of_old_lerobot_are_refused(tmp_path) -> None:
    (tmp_path / "old.json").write_text(json.dumps({"homing_offset": [2048], "calib_mode": ["DEGREE"]}))
    with pytest.raises(ConfigError, match="is a calibration of LeRobot before"):
        read_calibration(tmp_path / "old.json")
