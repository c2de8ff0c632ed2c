"""`bodyschema doctor`."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import sqlite3
import time
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bodyschema.cli.hardware import doctor
from bodyschema.cli.hardware.doctor import show
from bodyschema.cli.hardware.emulator_run import EmulatorRun
from bodyschema.cli.install.units import FOLDER
from bodyschema.cli.main import app
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.identity import Route
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.status import SamplerStatus
from bodyschema.daemon.transport.wire import encode
from bodyschema.daemon.wiring.servos import Check
from bodyschema.drivers import checks
from bodyschema.drivers.checks import Holder
from bodyschema.interfaces.records import MarkerFix
from bodyschema.recordings.store.store import PairStore, Session

EXAMPLE = Path(__file__).parents[2] / "examples" / "desk_arm" / "servos.toml"
LONGEST_S = 5.0
pytestmark = pytest.mark.usefixtures("patient_host")


def called(*arguments: object) -> int:
    try:
        app(list(map(str, arguments)), exit_on_error=False, result_action="return_value")
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


@pytest.fixture
def state(tmp_path, monkeypatch, free_endpoint) -> None:
    """Give this test its own state folder and endpoints."""
    monkeypatch.setenv("BODYSCHEMA_ZENOH_SAMPLER", free_endpoint())
    monkeypatch.setenv("BODYSCHEMA_ZENOH_LEARNER", free_endpoint())


@pytest.mark.usefixtures("state")
@pytest.mark.parametrize(
    ("file", "what"), [("servos.toml", "servos"), ("feetech.toml", "servos"), ("encoders.toml", "encoders")]
)
def test_healthy_emulator_arm_passes_within_five_seconds(file, what, tmp_path, capsys) -> None:
    with EmulatorRun(Config.load(EXAMPLE.with_name(file)), tmp_path / "bus") as run:
        begin = time.monotonic()
        code = called("doctor", "--robot", run.robot_file, "--json")
        assert time.monotonic() - begin < LONGEST_S * max(1.0, os.getloadavg()[0])  # a full machine takes its time
    told = json.loads(capsys.readouterr().out)
    assert (code, told["well"]) == (0, True)
    port = "port of arm" if what == "servos" else "port of board"
    assert {check["subject"] for check in told["checks"]} == {
        "robot.toml", "camera", port, what, "rate", "errors", "disk", "clock", "zenoh",
    }  # fmt: skip


@pytest.mark.usefixtures("state")
@pytest.mark.parametrize(
    ("file", "fault", "fix"),
    [
        ("servos.toml", "overload@elbow_pitch", "free the joint, then switch its supply off and on"),
        ("feetech.toml", "overload@elbow_pitch", "free the joint, then switch its supply off and on"),
    ],
)
def test_overloaded_servo_exits_1_with_its_remedy(file, fault, fix, tmp_path, capsys) -> None:
    with EmulatorRun(Config.load(EXAMPLE.with_name(file)), tmp_path / "bus", faults=[fault]) as run:
        code = called("doctor", "--robot", run.robot_file, "--json")
    wrong = [check for check in json.loads(capsys.readouterr().out)["checks"] if check["state"] == "wrong"]
    assert code == 1
    assert [check["fix"] for check in wrong] == [fix]


@pytest.mark.usefixtures("state")
def test_a_sensor_without_a_value_is_wrong(tmp_path, capsys) -> None:
    arm = Config.load(EXAMPLE.with_name("encoders.toml"))
    with EmulatorRun(arm, tmp_path / "bus", faults=["sensor@elbow_pitch"]) as run:
        assert called("doctor", "--robot", run.robot_file, "--json") == 1
    wrong = [check for check in json.loads(capsys.readouterr().out)["checks"] if check["state"] == "wrong"]
    assert ["elbow_pitch" in check["said"] for check in wrong] == [True]


@pytest.mark.usefixtures("state")
def test_suggested_command_names_the_given_robot_file(tmp_path, capsys) -> None:
    with EmulatorRun(Config.load(EXAMPLE), tmp_path / "bus", faults=["baud@elbow_pitch"]) as run:
        called("doctor", "--robot", run.robot_file, "--json")
    wrong = [check for check in json.loads(capsys.readouterr().out)["checks"] if check["state"] == "wrong"]
    assert [check["fix"].partition("    #")[0] for check in wrong] == [f"bodyschema scan --robot {run.robot_file}"]


@pytest.mark.usefixtures("state")
def test_ros_2_robot_without_router_is_wrong(tmp_path, free_endpoint, capsys) -> None:
    text = EXAMPLE.with_name("robot.toml").read_text()
    text = text.replace('"desk_arm.urdf"', f'"{EXAMPLE.with_name("desk_arm.urdf")}"')
    (tmp_path / "robot.toml").write_text(f'{text}\n[drivers.ros2]\nrouter = "{free_endpoint()}"\n')
    assert called("doctor", "--robot", tmp_path / "robot.toml", "--json") == 1
    wrong = [check for check in json.loads(capsys.readouterr().out)["checks"] if check["state"] == "wrong"]
    assert [(check["subject"], check["fix"]) for check in wrong] == [
        ("router", "Start it on the robot: ros2 run rmw_zenoh_cpp rmw_zenohd")
    ]


@pytest.mark.usefixtures("state")
def test_missing_port_is_reported_once(capsys) -> None:
    assert called("doctor", "--robot", EXAMPLE, "--json") == 1
    checks = json.loads(capsys.readouterr().out)["checks"]
    assert [check["subject"] for check in checks if check["state"] == "wrong"] == ["port of arm"]


@pytest.mark.usefixtures("state")
def test_running_sampler_supplies_servo_findings(tmp_path, monkeypatch, capsys) -> None:
    with EmulatorRun(Config.load(EXAMPLE), tmp_path / "bus") as run:
        config = Config.load(run.robot_file)
        holder = Holder(4711, "/usr/bin/python -m bodyschema run sampler --robot robot.toml")
        monkeypatch.setattr(checks, "holders", lambda *_: [holder])
        with ZenohSession(listen=config.tables.zenoh.sampler) as bus:
            keys = Keys(config.robot.name)
            bus.token(keys.alive("sampler"))
            bus.answer(keys.status("sampler"), lambda request: encode(status("joint 'elbow' is hot"), request.encoding))
            assert called("doctor", "--robot", run.robot_file, "--json") == 0
    said = {check["said"] for check in json.loads(capsys.readouterr().out)["checks"]}
    assert {"the running sampler takes 211 readings/s", "joint 'elbow' is hot"} <= said
    assert any(line.endswith("the running sampler has it open") for line in said)


def status(complaint: str) -> SamplerStatus:
    return SamplerStatus(
        robot="desk_arm", store="one", state="sampling", pairs=1, segment=1, uptime_s=1.0, frames=1, frames_per_s=1.0,
        readings_per_s=211.0, pairs_per_s=1.0, rejected={}, coverage={}, disk_free_bytes=1, health=[complaint],
        version="1",
    )  # fmt: skip


@pytest.mark.parametrize(("known", "state"), [(True, "ok"), (None, "ok"), (False, "warning")])
def test_unsynchronised_clock_is_a_warning(known, state) -> None:
    (check,) = doctor.clock_checks(lambda: known)
    assert check.state == state


@pytest.mark.parametrize(("free_mib", "state"), [(100, "wrong"), (500, "warning"), (5000, "ok")])
def test_nearly_full_disk_is_reported(tmp_path, monkeypatch, free_mib, state) -> None:
    usage = type("Usage", (), {"free": free_mib * 2**20})
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: usage)
    (check,) = doctor.disk_checks(tmp_path / "not" / "yet" / "there")
    assert check.state == state


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("bodyschema-sampler@.service", "install service"),
        ("bodyschema-learner@lab.service.d/robot.conf", "install service"),
        ("bodyschema-router.service", "install router"),
    ],
)
def test_unit_of_older_version_must_be_reinstalled(tmp_path, name, fix) -> None:
    file = tmp_path / FOLDER / name
    file.parent.mkdir(parents=True)
    file.write_text("[Service]\nExecStart=\nExecStart=/opt/arm/bin/python -P -m daemon sampler --robot robot.toml\n")
    (told,) = doctor.unit_checks(tmp_path)
    assert (told.state, str(file) in told.said, fix in told.fix) == ("wrong", True, True)


def test_unit_of_current_version_is_not_reported(tmp_path) -> None:
    file = tmp_path / FOLDER / "bodyschema-sampler@.service"
    file.parent.mkdir(parents=True)
    file.write_text("[Service]\nExecStart=/opt/arm/bin/python -P -m bodyschema run sampler --robot robot.toml\n")
    assert list(doctor.unit_checks(tmp_path)) == []


def test_a_free_endpoint_is_ok(endpoint) -> None:
    assert "is free for it" in doctor.zenoh_check("sampler", Route((endpoint,)), "x/alive").said


def test_a_process_that_answers_is_ok(endpoint) -> None:
    with ZenohSession(listen=endpoint) as bus:
        bus.token("x/alive")
        assert f"answers on {endpoint}" in doctor.zenoh_check("sampler", Route((endpoint,)), "x/alive").said


def test_foreign_process_on_the_endpoint_is_wrong() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        server.listen()
        check = doctor.zenoh_check("sampler", Route((f"tcp/127.0.0.1:{port}",)), "x/alive")
    assert check.state == "wrong"
    assert check.fix.startswith(f"ss -ltnp 'sport = :{port}'")


def test_a_screen_of_80_columns_keeps_commands_whole() -> None:
    long = "sudo usermod -aG dialout $USER && " * 4
    console = Console(file=StringIO(), width=80)
    show(console, [Check("port of arm", "wrong", "it may not be opened " * 8, long), Check("disk", "ok", "fine")])
    assert isinstance(console.file, StringIO)
    shown = console.file.getvalue()
    assert long.strip() in shown
    assert "1 wrong: the line below each says what to do." in shown


def test_all_well_is_one_sentence() -> None:
    console = Console(file=StringIO(), width=80)
    show(console, [Check("disk", "ok", "fine")])
    assert isinstance(console.file, StringIO)
    assert console.file.getvalue().endswith("All is well.\n")


# --- the store


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    session = Session(("waist",), "", "", "", "{}", "0", "here")
    with PairStore(tmp_path / "pairs.sqlite", session) as store:
        for k in range(5):
            store.append(1, "utc", np.array([0.1 * k]), MarkerFix(float(k), np.zeros(3), np.eye(3)))
    return store.file


def changed(file: Path, statement: str) -> Check:
    with contextlib.closing(sqlite3.connect(file)) as connection:
        connection.execute(statement)
        connection.commit()
    (check,) = doctor.store_checks(file)
    return check


def test_sound_store_is_reported_as_sound(stored) -> None:
    (check,) = doctor.store_checks(stored)
    assert (check.state, check.said) == ("ok", f"all 5 samples in {stored} are as they were written")


def test_changed_pair_is_reported_by_number(stored) -> None:
    check = changed(stored, "UPDATE pairs SET q = '[0.3]' WHERE seq = 3")
    assert check.state == "warning"
    assert "1 sample of" in check.said
    assert "(number 3)" in check.said


def test_changed_note_is_reported(stored) -> None:
    assert "1 notes on runs or servos" in changed(stored, "UPDATE sessions SET host = 'there'").said


def test_damaged_pages_are_reported_with_the_repair(stored) -> None:
    data = stored.read_bytes()
    page = data.index(b"here") // 4096
    stored.write_bytes(data[: page * 4096] + bytes(4096) + data[(page + 1) * 4096 :])
    (check,) = doctor.store_checks(stored)
    assert check.state == "wrong"
    assert "The sampler puts what can be read into a new file" in check.said


def test_a_state_folder_of_another_user_is_named(tmp_path, monkeypatch) -> None:
    def denied(_path: Path, **_options: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "stat", denied)
    (check,) = doctor.disk_checks(tmp_path)
    assert (check.state, "is not yours: Permission denied" in check.said) == ("wrong", True)
