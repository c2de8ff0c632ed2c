"""`bodyschema watch joints`: an arm on the emulator, moved joint by joint."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bodyschema.cli.hardware.emulator_run import EmulatorRun
from bodyschema.cli.hardware.joints_watch import ArmState, JointState, JointsWatch, SignCheck, Speeds, screen, signs_in
from bodyschema.cli.main import app
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.wiring import open_joints
from bodyschema.drivers.dynamixel.emulator.arm import DynamixelArm
from bodyschema.drivers.emulator.dry_run import DryRun
from bodyschema.interfaces.clock import SystemClock

EXAMPLE = Path(__file__).parents[2] / "examples" / "desk_arm" / "servos.toml"
YAW, PITCH, ELBOW, ROLL = range(4)


@pytest.fixture(scope="module")
def config() -> Config:
    return Config.load(EXAMPLE, {})


def signs(config: Config, *path: tuple[int, float], begin=(0.0, 0.0, 0.5, 0.0)) -> str:
    """Return the sign check's output after the joints moved by these angles [rad], one after the other, with rests."""
    check, q, t = SignCheck(config.robot), np.array(begin), 0.0
    for joint, turn in path:
        for step in np.linspace(0.0, turn, 30):
            moved = q.copy()
            moved[joint] += step
            t += 0.02
            check.take(t, moved)
        q = moved
        for _ in range(30):
            t += 0.05
            check.take(t, q)
    return check.prediction


def test_raised_arm_is_reported_in_urdf_direction(config) -> None:
    chain, q = config.robot.chain, np.array([0.0, 0.0, 0.5, 0.0])
    up = q.copy()
    up[PITCH] += 0.3
    T = config.robot.camera.pose[:3, :3]
    went = T @ (chain.positions(up[None])[0] - chain.positions(q[None])[0])
    axis = int(np.abs(went).argmax())
    expected = f"({'+-'[int(went[axis] < 0)]}{'xyz'[axis]} of base_link)"
    said = signs(config, (PITCH, 0.3))
    assert said.startswith("shoulder_pitch +17°: by the URDF the marker went ")
    assert said.endswith(expected)


def test_turned_back_it_goes_the_other_way(config) -> None:
    there, back = signs(config, (YAW, 0.3)), signs(config, (YAW, -0.3))
    assert {there.split("went ")[1].split()[0], back.split("went ")[1].split()[0]} == {"left", "right"}


def test_next_joint_is_reported_after_a_rest(config) -> None:
    assert signs(config, (YAW, 0.5), (ELBOW, -0.2)).startswith("elbow_pitch -11°")


def test_joint_not_moving_marker_is_reported_by_rotation(config) -> None:
    assert (
        signs(config, (ROLL, 0.5))
        == "wrist_roll +29°: by the URDF it turned counter-clockwise, its axis pointing at you"
    )


def test_noise_is_no_movement(config) -> None:
    assert signs(config, (YAW, 0.02)) == ""


# --- on the emulator


def test_the_watch_has_angles_speeds_temperatures_and_ranges(config, tmp_path, patient_host) -> None:
    shoulder = [0.2]
    angles = {joint: (lambda _: 0.1) for joint in config.robot.joints} | {"shoulder_pitch": lambda _: shoulder[0]}
    servos = config.tables.drivers.dynamixel
    with DryRun(DynamixelArm(servos, angles), {"arm": tmp_path / "bus"}) as emulator:
        (tmp_path / "desk_arm.urdf").write_bytes(config.robot.tree.file.read_bytes())
        (tmp_path / "robot.toml").write_text(
            EXAMPLE.read_text().replace(servos.buses["arm"].port, str(tmp_path / "bus"))
        )
        there = Config.load(tmp_path / "robot.toml", {})
        with JointsWatch(there, open_joints(there, SystemClock()), SystemClock()) as watch:
            look_until(watch, lambda seen: True)
            for shoulder[0] in np.linspace(0.2, 0.6, 20):
                look_until(watch, lambda seen: abs(seen.joints[PITCH].angle - shoulder[0]) < 0.01)
            watch.read_temperatures()
            seen = look_until(watch, lambda seen: True)
        assert emulator.arm.count > 20
    pitch = seen.joints[PITCH]
    assert (pitch.low, pitch.high) == pytest.approx((0.2, 0.6), abs=0.01)
    assert [joint.temperature_c for joint in seen.joints] == [31.0] * 4
    assert [joint.current for joint in seen.joints] == [0.0, 0.0, 0.0, None]
    assert seen.moved.startswith("shoulder_pitch +")


def look_until(watch: JointsWatch, done) -> ArmState:
    for _ in range(1000):
        seen = watch.look()
        if seen is not None and done(seen):
            return seen
    raise AssertionError("it was never seen")


@pytest.mark.usefixtures("patient_host")
@pytest.mark.parametrize(
    ("file", "ids"), [("servos.toml", [1, 2, 3, 4]), ("feetech.toml", [1, 2, 3, 4]), ("encoders.toml", [None] * 4)]
)
def test_once_gives_one_line_of_json(file, ids, tmp_path, capsys) -> None:
    with EmulatorRun(Config.load(EXAMPLE.with_name(file), {}), tmp_path / "bus") as run:
        app(
            ["watch", "joints", "--robot", str(run.robot_file), "--once", "--json"],
            exit_on_error=False,
            result_action="return_value",
        )
    (line,) = capsys.readouterr().out.splitlines()
    assert [joint["id"] for joint in json.loads(line)["joints"]] == ids
    assert [joint["joint"] for joint in json.loads(line)["joints"]] == [
        "base_yaw",
        "shoulder_pitch",
        "elbow_pitch",
        "wrist_roll",
    ]


def test_missing_encoder_speed_is_derived_from_angles() -> None:
    speeds = Speeds(1)
    for k in range(100):
        speeds.take(0.01 * k, np.array([0.3 * 0.01 * k]))
    assert speeds.v == pytest.approx([0.3])


# --- the screen


def shown(signs_in: str = "direction = -1", **changes) -> str:
    state = {"joint": "elbow", "id": 3, "angle": 0.5, "velocity": -0.5, "current": 0.12, "temperature_c": 40.0}
    state |= {"low": 0.0, "high": 0.6, "lower": -1.0, "upper": 1.0, "within_limits": True} | changes
    console = Console(file=StringIO(), width=80)
    console.print(
        screen(ArmState((JointState(**state),), "elbow +20°: by the URDF the marker went up", (), None, signs_in))
    )
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def test_the_screen_shows_a_joint_in_degrees() -> None:
    row = next(line for line in shown().splitlines() if line.startswith("elbow "))
    assert row.split()[1:6] == ["3", "+28.6°", "-29", "+120", "40"]
    assert len(row.rstrip()) <= 80


def test_screen_shows_marker_motion_and_remedy() -> None:
    assert "the marker went up" in shown()
    assert "direction = -1" in shown()


def test_ros_2_advice_names_no_servo_keys() -> None:
    said = signs_in(is_ros2=True, is_plugin=False)
    text = " ".join(shown(said, high=1.4, within_limits=False).split())
    assert "[drivers.ros2.names] or the URDF" in text
    assert "direction" not in text
    assert "zero_ticks" not in text


def test_unmeasured_value_is_a_dash() -> None:
    row = next(line for line in shown(current=None, temperature_c=None).splitlines() if line.startswith("elbow "))
    assert row.split()[4:6] == ["-", "-"]


def test_angle_beyond_the_limits_is_reported() -> None:
    assert "elbow was from +0° to +80°, its limits are -57° to +57°" in shown(high=1.4, within_limits=False)


@pytest.mark.usefixtures("patient_host")
def test_watch_reports_an_overloaded_servo(tmp_path, capsys) -> None:
    with EmulatorRun(Config.load(EXAMPLE), tmp_path / "bus", faults=["overload@wrist_roll"]) as run:
        app(["watch", "joints", "--robot", str(run.robot_file), "--once", "--json"], result_action="return_value")
    (complaint,) = json.loads(capsys.readouterr().out)["health"]
    assert complaint.startswith("joint 'wrist_roll': it is overloaded")
