"""`bodyschema init --from`: a servo for each joint."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest

from bodyschema.cli.hardware.emulator_run import EmulatorRun
from bodyschema.cli.main import command_line
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.servos import servos_of
from bodyschema.interfaces.errors import ConfigError

EXAMPLE = Path(__file__).parents[2] / "examples" / "desk_arm"
JOINTS = ("base_yaw", "shoulder_pitch", "elbow_pitch", "wrist_roll")


def new(*arguments: object) -> None:
    source = () if "--from" in arguments else ("--from", "scan")
    words = ["init", "--urdf", EXAMPLE / "desk_arm.urdf", *source, *arguments]
    command_line("init")(list(map(str, words)), exit_on_error=False, result_action="return_value")


def scan(file: Path, *servos: tuple[int, str], port: str = "/dev/ttyUSB0", **more: object) -> Path:
    found = [{"port": port, "baud": 57600, "id": id, "model": model, "firmware": 46, **more} for id, model in servos]
    file.write_text(json.dumps({"well": True, "ports": [{"port": port, "servos": found, "trouble": None}]}))
    return file


@pytest.fixture
def four(tmp_path: Path) -> Path:
    """Return a saved scan with a servo for each joint."""
    return scan(tmp_path / "found.json", (3, "XL330-M288"), (1, "XM430-W350"), (2, "XM430-W350"), (7, "MX-28"))


def servos(file: Path) -> dict[str, tuple[int, str]]:
    table = servos_of(Config.load(file, {}))
    assert table is not None
    return {servo.joint: (servo.id, servo.model) for servo in table.servos}


def test_joints_get_servos_in_order_of_id(four, tmp_path, capsys) -> None:
    new("--from", four, "--robot", tmp_path / "robot.toml", "--yes")
    assert list(servos(tmp_path / "robot.toml").items()) == list(
        zip(JOINTS, [(1, "XM430-W350"), (2, "XM430-W350"), (3, "XL330-M288"), (7, "MX-28")], strict=True)
    )
    assert "base_yaw: ID 1, XM430-W350" in capsys.readouterr().out


def test_port_and_rate_are_those_of_the_scan(four, tmp_path) -> None:
    new("--from", four, "--robot", tmp_path / "robot.toml", "--yes")
    bus = Config.load(tmp_path / "robot.toml", {}).tables.drivers.dynamixel.buses["arm"]
    assert (bus.port, bus.baud) == ("/dev/ttyUSB0", 57600)


def test_values_still_to_check_are_marked(four, tmp_path) -> None:
    new("--from", four, "--robot", tmp_path / "robot.toml", "--yes")
    text = (tmp_path / "robot.toml").read_text()
    assert "# CHECK each with `bodyschema watch joints`" in text
    assert text.count("# direction = -1") == 4


def test_it_asks_which_servo_moves_which_joint(four, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("7\n\n-\n3\n"))
    new("--from", four, "--robot", tmp_path / "robot.toml")
    assert servos(tmp_path / "robot.toml") == {
        "base_yaw": (7, "MX-28"), "shoulder_pitch": (1, "XM430-W350"), "wrist_roll": (3, "XL330-M288"),
    }  # fmt: skip
    assert Config.load(tmp_path / "robot.toml", {}).robot.joints == ("base_yaw", "shoulder_pitch", "wrist_roll")


def test_missing_and_surplus_servos_are_reported(tmp_path, capsys) -> None:
    new("--from", scan(tmp_path / "a", (1, "MX-28")), "--robot", tmp_path / "few.toml", "--yes")
    assert "wrist_roll: no servo, so it is not in joints" in capsys.readouterr().out
    many = scan(tmp_path / "b", *((id, "MX-28") for id in range(6)))
    new("--from", many, "--robot", tmp_path / "many.toml", "--yes")
    assert "ID 5, MX-28: moves none of the joints" in capsys.readouterr().out


@pytest.mark.parametrize("more", [{"is_double": True}, {"model": "model 999"}, {"model": None}])
def test_servos_that_cannot_be_used_are_refused(tmp_path, more) -> None:
    file = tmp_path / "found.json"
    servo = {"port": "p", "baud": 57600, "id": 1, "model": "MX-28", **more}
    file.write_text(json.dumps({"ports": [{"servos": [servo]}]}))
    with pytest.raises(ConfigError, match="no servo was found that can be used"):
        new("--from", file, "--robot", tmp_path / "robot.toml", "--yes")


def test_a_file_is_not_replaced(four, tmp_path) -> None:
    (tmp_path / "robot.toml").write_text("precious")
    with pytest.raises(ConfigError, match="is there already"):
        new("--from", four, "--robot", tmp_path / "robot.toml", "--yes")
    assert (tmp_path / "robot.toml").read_text() == "precious"


@pytest.mark.parametrize(("text", "said"), [("{}", "is no scan"), ("nonsense", "is no scan"), (None, "cannot be read")])
def test_invalid_scan_file_error_names_the_scan_command(tmp_path, text, said) -> None:
    if text is not None:
        (tmp_path / "found.json").write_text(text)
    with pytest.raises(ConfigError, match=f"{said}.*bodyschema scan --json"):
        new("--from", tmp_path / "found.json", "--robot", tmp_path / "robot.toml", "--yes")
    assert not (tmp_path / "robot.toml").exists()


def test_two_ports_are_two_buses(tmp_path) -> None:
    found = [{"port": port, "baud": 57600, "id": 1, "model": "MX-28"} for port in ("/dev/a", "/dev/b")]
    (tmp_path / "found.json").write_text(json.dumps({"ports": [{"servos": [servo]} for servo in found]}))
    new("--from", tmp_path / "found.json", "--robot", tmp_path / "robot.toml", "--yes")
    table = Config.load(tmp_path / "robot.toml", {}).tables.drivers.dynamixel
    assert [(servo.bus, table.buses[servo.bus].port) for servo in table.servos] == [
        ("bus1", "/dev/a"),
        ("bus2", "/dev/b"),
    ]


def test_servos_of_two_makes_make_no_arm(tmp_path) -> None:
    mixed = scan(tmp_path / "found.json", (1, "STS3215"), (2, "MX-28"))
    with pytest.raises(ConfigError, match=r"of two vendors, drivers\.feetech and drivers\.dynamixel"):
        new("--from", mixed, "--robot", tmp_path / "robot.toml", "--yes")
    assert not (tmp_path / "robot.toml").exists()


def test_servo_at_unsupported_rate_is_not_used(tmp_path) -> None:
    found = scan(tmp_path / "found.json", (1, "MX-28"), baud=500_000)
    with pytest.raises(ConfigError, match="no servo was found that can be used"):
        new("--from", found, "--robot", tmp_path / "robot.toml", "--yes")


def test_default_zero_of_a_model_is_written(tmp_path) -> None:
    new("--from", scan(tmp_path / "found.json", (1, "SCS0009")), "--robot", tmp_path / "robot.toml", "--yes")
    assert "# zero_ticks = 512 " in (tmp_path / "robot.toml").read_text()


@pytest.mark.usefixtures("patient_host")
@pytest.mark.parametrize(
    ("file", "models"),
    [
        ("servos.toml", ["XM430-W350", "XM540-W270", "XM430-W350", "MX-28"]),
        ("feetech.toml", ["STS3215", "STS3250", "STS3215", "STS3215"]),
    ],
)
def test_emulator_servos_are_found_and_written(file, models, tmp_path) -> None:
    with EmulatorRun(Config.load(EXAMPLE / file, {}), tmp_path / "bus"):
        new("--port", tmp_path / "bus", "--baud", 1000000, "--robot", tmp_path / "robot.toml", "--yes")
    assert [model for _, model in servos(tmp_path / "robot.toml").values()] == models
