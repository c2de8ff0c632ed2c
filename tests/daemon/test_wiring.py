from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_arm import write_small_arm

from daemon.config import Config
from daemon.wiring import check_sources, demonstration_model, open_joints, open_sources, require_simulation
from interfaces.clock import SystemClock
from interfaces.errors import ConfigError, RecordingError, SourceLost
from interfaces.records import MarkerFix


def load(folder: Path, tables: str = "") -> Config:
    return Config.load(write_small_arm(folder, tables), {})


def enter(config: Config, *, sim: bool) -> None:
    with open_sources(config, sim=sim):
        pass


def test_without_a_driver_the_two_ways_out_are_named(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"no driver is configured. Give --sim .*recording in the table \[drivers\]"):
        enter(load(tmp_path), sim=False)


def test_sources_can_be_checked_without_opening_any(tmp_path) -> None:
    with pytest.raises(ConfigError, match="no driver is configured"):
        check_sources(load(tmp_path), sim=False)


def test_a_recording_is_found_beside_robot_toml_and_read(tmp_path) -> None:
    (tmp_path / "walk.csv").write_text("waist,shoulder,x,y,z\n0.1,0.2,0.3,0.4,0.5\n")
    config = load(tmp_path, '[drivers]\nrecording = "walk.csv"\nspeed = 0\n')
    with open_sources(config, sim=False) as sources, sources.joints, sources.marker:
        fix = sources.marker.read(1.0)
    assert isinstance(fix, MarkerFix)
    assert np.array_equal(fix.x, [0.3, 0.4, 0.5])


def test_a_recording_with_a_mistake_names_line_and_column(tmp_path) -> None:
    (tmp_path / "walk.csv").write_text("waist,shoulder,x,y,z\n0.1,0.2,0.3,0.4,0.5\n0.1,nan,0.3,0.4,0.5\n")
    with pytest.raises(RecordingError, match=r"walk.csv, line 3, column shoulder"):
        enter(load(tmp_path, '[drivers]\nrecording = "walk.csv"\n'), sim=False)


def test_a_recording_that_is_not_there_is_named(tmp_path) -> None:
    with pytest.raises(RecordingError, match=r"walk.csv"):
        enter(load(tmp_path, '[drivers]\nrecording = "walk.csv"\n'), sim=False)


def test_the_simulation_asks_for_a_stereo_camera(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"describes no stereo pair.*Add focal_px"):
        enter(load(tmp_path), sim=True)


def test_without_pybullet_the_simulation_names_the_extra(monkeypatch) -> None:
    monkeypatch.setattr("daemon.extras.find_spec", lambda _name: None)
    with pytest.raises(ConfigError, match=r"Type: pip install 'bodyschema\[sim\]'"):
        require_simulation()


def test_the_demonstration_model_is_a_robot_in_order() -> None:
    assert Config.load(demonstration_model(), {}).robot.calibration is not None


SERVOS = """
[drivers.dynamixel.buses.arm]
port = "/dev/serial/by-id/none"

[[drivers.dynamixel.servos]]
joint = "waist"
id = 1
model = "XM430-W350"

[[drivers.dynamixel.servos]]
joint = "shoulder"
id = 2
model = "MX-28"
"""


def test_servos_in_robot_toml_are_the_joint_source(tmp_path) -> None:
    source = open_joints(load(tmp_path, SERVOS), SystemClock())
    assert source.joints == ("waist", "shoulder")
    with pytest.raises(SourceLost, match=r"by-id/none is gone: No such file"), source:
        pass


def test_servos_without_a_camera_make_no_pairs(tmp_path) -> None:
    with pytest.raises(ConfigError, match="nothing tells where the marker is"):
        enter(load(tmp_path, SERVOS), sim=False)


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ('"waist"', '"waste"', r"unknown joint 'waste'. Did you mean 'waist'\?"),
        ('"shoulder"', '"waist"', "a second servo for the joint 'waist'"),
        ("id = 2", "id = 1", "the ID 1 is given twice on one bus"),
        ("id = 2", "id = 300", "drivers.dynamixel.servos.id: expected `int` <= 252"),
        ('"MX-28"', '"MX28"', "unknown model 'MX28'. Did you mean 'MX-28'"),
        ('"MX-28"', '"XL320"', "unknown model 'XL320'. No driver reads an XL-320"),
        ("id = 2", 'id = 2\nbus = "leg"', "unknown bus 'leg'"),
        ("id = 2", "id = 2\nzero = 1", "unknown key 'zero' in .*Known are: .*zero_ticks"),
    ],
)
def test_a_mistake_about_servos_is_named_with_its_line(tmp_path, right, wrong, said) -> None:
    with pytest.raises(ConfigError, match=rf"robot.toml, line \d+: .*{said}"):
        load(tmp_path, SERVOS.replace(right, wrong))


def test_a_rate_that_no_servo_has_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"buses\.baud: 12345 is unknown, known are: 9600, 57600"):
        load(tmp_path, SERVOS.replace("port =", "baud = 12345\nport ="))


def test_a_joint_without_a_servo_is_named(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"no servo .* for shoulder"):
        load(tmp_path, SERVOS[: SERVOS.rindex("[[")])


def test_a_recording_and_servos_exclude_each_other(tmp_path) -> None:
    with pytest.raises(ConfigError, match="both a recording and servos"):
        load(tmp_path, '[drivers]\nrecording = "walk.csv"\n' + SERVOS)


FEETECH = SERVOS.replace("dynamixel", "feetech").replace('"XM430-W350"', '"STS3215"').replace('"MX-28"', '"SCS0009"')
ENCODERS = """
[drivers.serial_lines]
port = "/dev/serial/by-id/none"

[[drivers.serial_lines.encoders]]
joint = "waist"

[[drivers.serial_lines.encoders]]
joint = "shoulder"
encoder = "upper"
"""


@pytest.mark.parametrize("tables", [FEETECH, ENCODERS])
def test_other_hardware_in_robot_toml_is_the_joint_source(tmp_path, tables) -> None:
    source = open_joints(load(tmp_path, tables), SystemClock())
    assert source.joints == ("waist", "shoulder")
    with pytest.raises(SourceLost, match=r"by-id/none is gone: No such file"), source:
        pass


@pytest.mark.parametrize(
    ("tables", "right", "wrong", "said"),
    [
        (FEETECH, '"STS3215"', '"STS3251"', "unknown model 'STS3251'. Did you mean 'STS3250'"),
        (FEETECH, '"waist"', '"waste"', r"unknown joint 'waste'. Did you mean 'waist'\?"),
        (FEETECH, "id = 2", "id = 1", "the ID 1 is given twice on one bus"),
        (ENCODERS, '"shoulder"', '"waist"', "a second encoder for the joint 'waist'"),
        (ENCODERS, '"upper"', '"waist"', "the encoder 'waist' is given twice"),
        (ENCODERS, "encoder =", "encode =", "unknown key 'encode' in .*Did you mean 'encoder'"),
        (ENCODERS, 'joint = "waist"', 'joint = "waist"\ndirection = 2', "direction"),
        (ENCODERS, "port =", "baud = 5\nport =", "baud"),
    ],
)
def test_a_mistake_about_other_hardware_is_named_with_its_line(tmp_path, tables, right, wrong, said) -> None:
    with pytest.raises(ConfigError, match=rf"robot.toml, line \d+: .*{said}"):
        load(tmp_path, tables.replace(right, wrong))


def test_a_joint_without_an_encoder_is_named(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"no encoder .* for shoulder"):
        load(tmp_path, ENCODERS[: ENCODERS.rindex("[[")])


def test_a_rate_that_no_feetech_servo_has_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"buses\.baud: 12345 is unknown, known are: 19200, 38400"):
        load(tmp_path, FEETECH.replace("port =", "baud = 12345\nport ="))


def test_joints_come_from_one_kind_of_hardware(tmp_path) -> None:
    with pytest.raises(ConfigError, match="cannot come from both dynamixel and serial_lines"):
        load(tmp_path, SERVOS + ENCODERS)


def test_a_recording_and_encoders_exclude_each_other(tmp_path) -> None:
    with pytest.raises(ConfigError, match="both a recording and encoders"):
        load(tmp_path, '[drivers]\nrecording = "walk.csv"\n' + ENCODERS)
