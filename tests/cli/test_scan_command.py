"""`bodyschema scan`: findings compared with robot.toml."""

from __future__ import annotations

import json
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from bodyschema.cli.hardware.emulator_run import EmulatorRun
from bodyschema.cli.hardware.scan_report import ScanReport, as_json, report_of, show
from bodyschema.cli.main import app
from bodyschema.daemon.config import Config
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.servos import FoundServo, ScannedBus

EXAMPLE = Path(__file__).parents[2] / "examples" / "desk_arm" / "servos.toml"
JOINTS = ("base_yaw", "shoulder_pitch", "elbow_pitch", "wrist_roll")
MODELS = ("XM430-W350", "XM540-W270", "XM430-W350", "MX-28")


@pytest.fixture(scope="module")
def config() -> Config:
    return Config.load(EXAMPLE, {})


@pytest.fixture(scope="module")
def port(config) -> str:
    return config.tables.drivers.dynamixel.buses["arm"].port


@pytest.fixture
def arm(port) -> list[FoundServo]:
    """Return the servos of robot.toml as they should be."""
    return [
        FoundServo(port, 1_000_000, "Dynamixel 2.0", id, model, "46", 12.0, 31.0, False)
        for id, model in enumerate(MODELS, 1)
    ]


def report(config: Config | None, servos: list[FoundServo], port: str) -> ScanReport:
    ports = dict.fromkeys([port, *(servo.port for servo in servos)])
    return report_of([ScannedBus(p, tuple(s for s in servos if s.port == p)) for p in ports], config)


def states(told: ScanReport) -> list[str]:
    return [joint.state for joint in told.joints or ()]


def screen(told: ScanReport) -> str:
    console = Console(file=StringIO(), width=80, highlight=False)
    show(console, told)
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def test_servos_matching_robot_toml_are_ok(config, arm, port) -> None:
    told = report(config, arm, port)
    assert (states(told), told.is_well) == (["ok"] * 4, True)


def test_a_missing_servo_is_named_with_its_joint(config, arm, port) -> None:
    told = report(config, arm[:1] + arm[2:], port)
    assert (states(told)[1], told.is_well) == ("missing", False)
    assert "joint shoulder_pitch (ID 2, XM540-W270): missing: look at its supply and cable" in screen(told)


@pytest.mark.parametrize(
    ("change", "state", "fix"),
    [
        ({"model": "XL330-M288"}, "wrong model", 'set model = "XL330-M288"'),
        ({"model": "XL-320"}, "wrong model", "it is a XL-320, which no driver reads: put a XM540-W270 in its place"),
        ({"model": None}, "not known", "it does not report its model"),
        ({"baud": 57_600}, "another rate", "give the servo 1,000,000 bit/s, or set baud = 57600"),
        ({"port": "/dev/ttyUSB9"}, "another port", 'set port = "/dev/ttyUSB9"'),
        ({"is_double": True}, "double", "give the other another ID"),
    ],
)
def test_deviating_servo_is_reported_with_its_remedy(config, arm, port, change, state, fix) -> None:
    arm[1] = replace(arm[1], **change)
    told = report(config, arm, port)
    assert states(told) == ["ok", state, "ok", "ok"]
    assert told.joints is not None
    assert fix in told.joints[1].fix
    assert not told.is_well


def test_servo_absent_from_robot_toml_is_a_stranger(config, arm, port) -> None:
    told = report(config, [*arm, FoundServo(port, 1_000_000, "Dynamixel 2.0", 9, "XL330-M288")], port)
    assert ([servo.id for servo in told.strangers], told.is_well) == ([9], False)
    assert "ID 9 (XL330-M288) is on a port of robot.toml, but not in it" in screen(told)


def test_servos_of_other_ports_are_no_strangers(config, arm, port) -> None:
    assert report(config, [*arm, FoundServo("/dev/ttyACM7", 1_000_000, "Dynamixel 2.0", 9)], port).is_well


def test_any_answering_servo_passes_without_a_robot(arm, port) -> None:
    assert report(None, arm, port).is_well
    assert not report(None, [], port).is_well


def test_unopenable_port_is_reported(port) -> None:
    told = report_of([ScannedBus(port, (), f"{port} is in use by another program. End that one")], None)
    assert "is in use by another program" in screen(told)
    assert not told.is_well


def test_the_table_fits_80_columns_and_shows_everything(config, arm, port) -> None:
    lines = [line for line in screen(report(config, arm, port)).splitlines() if "XM" in line or "MX" in line]
    assert max(map(len, lines)) <= 80
    assert lines[1].split() == [
        "2", "XM540-W270", "46", "Dynamixel", "2.0", "1", "M", "12.0", "V", "31", "°C", "off", "shoulder_pitch",
    ]  # fmt: skip


def test_servo_troubles_are_listed_below_the_table(arm, port) -> None:
    arm[0] = replace(arm[0], troubles=("it is overloaded: free the joint, then switch its supply off and on",))
    assert "ID 1: it is overloaded" in screen(report(None, arm, port))


def test_json_has_ports_joints_and_strangers(config, arm, port) -> None:
    told = json.loads(as_json(report(config, arm, port)))
    assert told["well"] is True
    assert [joint["joint"] for joint in told["joints"]] == list(JOINTS)
    assert told["ports"][0]["servos"][3]["model"] == "MX-28"
    assert told["strangers"] == []


@pytest.mark.usefixtures("patient_host")
def test_emulator_is_found_by_the_command(tmp_path, capsys) -> None:
    with EmulatorRun(Config.load(EXAMPLE, {}), tmp_path / "bus") as run:
        arguments = ["scan", "--port", tmp_path / "bus", "--baud", 1000000, "--robot", run.robot_file, "--json"]
        app(list(map(str, arguments)), exit_on_error=False, result_action="return_value")
    told = json.loads(capsys.readouterr().out)
    assert told["well"] is True
    assert [joint["servo"]["id"] for joint in told["joints"]] == [1, 2, 3, 4]


def test_unknown_rate_error_lists_known_rates() -> None:
    with pytest.raises(ConfigError, match=r"--baud 1234 is no rate.*57600"):
        app(["scan", "--baud", "1234"], exit_on_error=False, result_action="return_value")


def test_a_robot_without_servos_cannot_be_compared() -> None:
    with pytest.raises(ConfigError, match="no servos are configured"):
        app(
            ["scan", "--robot", str(EXAMPLE.with_name("robot.toml"))], exit_on_error=False, result_action="return_value"
        )
