from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_arm import write_small_arm

from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.simulation import simulation_settings
from bodyschema.daemon.wiring.wiring import check_sources, demonstration_model, open_joints, open_postures, open_sources
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, RecordingError, SourceLost
from bodyschema.interfaces.records import MarkerFix


def load(folder: Path, tables: str = "") -> Config:
    return Config.load(write_small_arm(folder, tables), {})


def enter(config: Config, *, sim: bool) -> None:
    with open_sources(config, sim=sim):
        pass


def test_missing_driver_error_names_sim_and_recording(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"no driver is configured. Give --sim .*recording in the table \[drivers\]"):
        enter(load(tmp_path), sim=False)


def test_sources_can_be_checked_without_opening_any(tmp_path) -> None:
    with pytest.raises(ConfigError, match="no driver is configured"):
        check_sources(load(tmp_path), sim=False)


def test_recording_beside_robot_toml_is_read(tmp_path) -> None:
    (tmp_path / "walk.csv").write_text("waist,shoulder,x,y,z\n0.1,0.2,0.3,0.4,0.5\n")
    config = load(tmp_path, '[drivers]\nrecording = "walk.csv"\nspeed = 0\n')
    with open_sources(config, sim=False) as sources, sources.joints, sources.marker:
        fix = sources.marker.read(1.0)
    assert isinstance(fix, MarkerFix)
    assert np.array_equal(fix.x, [0.3, 0.4, 0.5])


def test_recording_mistake_is_named_with_line_and_column(tmp_path) -> None:
    (tmp_path / "walk.csv").write_text("waist,shoulder,x,y,z\n0.1,0.2,0.3,0.4,0.5\n0.1,nan,0.3,0.4,0.5\n")
    with pytest.raises(RecordingError, match=r"walk.csv, line 3, column shoulder"):
        enter(load(tmp_path, '[drivers]\nrecording = "walk.csv"\n'), sim=False)


def test_a_recording_that_is_not_there_is_named(tmp_path) -> None:
    with pytest.raises(RecordingError, match=r"walk.csv"):
        enter(load(tmp_path, '[drivers]\nrecording = "walk.csv"\n'), sim=False)


def test_the_simulation_asks_for_a_stereo_camera(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"does not describe how the cameras see.*Add focal_px"):
        enter(load(tmp_path), sim=True)


STEREO = """xyz = [1.1, 0.0, 0.1]
rpy = [-1.5707963, 0.0, 1.5707963]
focal_px = 600.0
principal_point_px = [319.5, 239.5]
baseline_m = 0.1
image_size_px = [640, 480]
"""
COLOUR = "[vision]\n[vision.colour]\nhue_deg = 200\nhalf_width_deg = {}\nmin_saturation = {}\nmin_value = {}\n"
CLUSTER = """[vision]
marker = "cluster"
[vision.tag]
dictionary = "aruco_mip_36h12"
[[vision.cluster.tags]]
id = 7
xyz = [0.0, 0.0, 0.05]
rpy = [0.0, 1.2, 0.0]
side_m = 0.06
[[vision.cluster.tags]]
id = 8
"""
CHESSBOARD = '[vision]\nmarker = "chessboard"\n[vision.chessboard]\ncolumns = 7\nrows = 4\nsquare_m = 0.0121\n'


@pytest.mark.parametrize(
    ("vision", "shown"),
    [
        ("", {"ball_radius_m": 0.02, "light": 1.0, "clutter_gap_deg": 36.0}),
        ('[vision]\ncolour = "green"\nradius_m = 0.015\n', {"ball_radius_m": 0.015, "rgb": (0.0602, 0.86, 0.0602)}),
        ('[vision]\ncolour = "yellow"\n', {"clutter_gap_deg": 36.0}),
        (COLOUR.format(60, 0.8, 0.5), {"clutter_gap_deg": 66.0}),
        ('[vision]\nmarker = "bright_ball"\n', {"rgb": (0.9, 0.9, 0.9), "light": 0.27}),
        ('[vision]\nmarker = "tag"\n[vision.tag]\nid = 3\nside_m = 0.05\n', {"tag_dictionary": 20}),
        (CLUSTER, {"marker_radius_m": pytest.approx(0.0729, abs=1e-4)}),
        (CHESSBOARD, {"marker_radius_m": pytest.approx(0.0571, abs=1e-4)}),
    ],
    ids=["red", "green", "yellow", "band", "bright", "tag", "cluster", "chessboard"],
)
def test_the_simulation_shows_the_marker_of_vision(tmp_path, vision, shown) -> None:
    camera = simulation_settings(load(tmp_path, STEREO + vision)).camera
    assert {name: getattr(camera, name) for name in shown} == {
        name: value if isinstance(value, int) else pytest.approx(value) for name, value in shown.items()
    }


def test_sim_camera_may_show_another_marker(tmp_path) -> None:
    asked = '[vision]\ncolour = "green"\n[sim.camera]\nball_radius_m = 0.021\nball_rgb = [0.1, 0.8, 0.2]\n'
    camera = simulation_settings(load(tmp_path, STEREO + asked)).camera
    assert (camera.ball_radius_m, camera.ball_rgb) == (0.021, (0.1, 0.8, 0.2))


@pytest.mark.parametrize(
    ("tables", "keys"),
    [
        (COLOUR.format(20, 0.5, 0.97), r"\[vision.colour\] or"),
        ('[vision]\nmarker = "bright_ball"\nmin_brightness = 1.0\n', r"\[vision\] min_brightness"),
        ('[vision]\nmarker = "tag"\n[vision.tag]\nside_m = 0.005\n', r"\[vision.tag\]"),
        ("[sim.camera]\nball_rgb = [0.1, 0.8, 0.2]\n", r"\[vision.colour\] or"),
    ],
)
def test_untrackable_simulated_marker_is_reported(tmp_path, tables, keys) -> None:
    with pytest.raises(ConfigError, match=rf"robot.toml: the tracker would not find the marker .*Change {keys}"):
        check_sources(load(tmp_path, STEREO + tables), sim=True)


def test_small_green_balls_make_fixes_in_the_simulation(tmp_path) -> None:
    config = load(tmp_path, STEREO + '[vision]\ncolour = "green"\nradius_m = 0.015\n')
    with open_postures(config, 2) as sources, sources.marker:
        seen = [sources.marker.read(60.0) for _ in range(2)]
    assert [type(fix) for fix in seen] == [MarkerFix, MarkerFix]


def test_without_pybullet_the_simulation_names_the_extra(monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.interfaces.extras.find_spec", lambda _name: None)
    with pytest.raises(ConfigError, match=r"Type: .*pip install 'bodyschema\[sim\]'"):
        check_sources(Config.load(demonstration_model(), {}), sim=True)


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
    with pytest.raises(SourceLost, match=r"by-id/none is not there: No such file"), source:
        pass


def test_servos_without_a_camera_make_no_pairs(tmp_path) -> None:
    with pytest.raises(ConfigError, match="nothing measures the marker"):
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
def test_dynamixel_setting_mistake_is_named_with_line(tmp_path, right, wrong, said) -> None:
    with pytest.raises(ConfigError, match=rf"robot.toml, line \d+: .*{said}"):
        load(tmp_path, SERVOS.replace(right, wrong))


def test_unknown_dynamixel_baud_rate_is_refused(tmp_path) -> None:
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
def test_feetech_or_encoder_table_is_the_joint_source(tmp_path, tables) -> None:
    source = open_joints(load(tmp_path, tables), SystemClock())
    assert source.joints == ("waist", "shoulder")
    with pytest.raises(SourceLost, match=r"by-id/none is not there: No such file"), source:
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
def test_feetech_or_encoder_mistake_is_named_with_line(tmp_path, tables, right, wrong, said) -> None:
    with pytest.raises(ConfigError, match=rf"robot.toml, line \d+: .*{said}"):
        load(tmp_path, tables.replace(right, wrong))


def test_a_joint_without_an_encoder_is_named(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"no encoder .* for shoulder"):
        load(tmp_path, ENCODERS[: ENCODERS.rindex("[[")])


def test_unknown_feetech_baud_rate_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"buses\.baud: 12345 is unknown, known are: 19200, 38400"):
        load(tmp_path, FEETECH.replace("port =", "baud = 12345\nport ="))


def test_joints_come_from_one_kind_of_hardware(tmp_path) -> None:
    with pytest.raises(ConfigError, match="cannot come from both dynamixel and serial_lines"):
        load(tmp_path, SERVOS + ENCODERS)


def test_a_recording_and_encoders_exclude_each_other(tmp_path) -> None:
    with pytest.raises(ConfigError, match="both a recording and encoders"):
        load(tmp_path, '[drivers]\nrecording = "walk.csv"\n' + ENCODERS)
