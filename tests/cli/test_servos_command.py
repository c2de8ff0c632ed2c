"""`bodyschema servos` against dynamixel-sdk's servos on a pseudo-terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import dynamixel_sdk as sdk
import msgspec
import pytest

from bodyschema.cli.main import command_line
from bodyschema.cli.servos.log import FILE, LoggedWrite, ServoLog
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.emulators import Motion, emulator_robot_file, open_emulator
from bodyschema.drivers.emulator.dry_run import DryRun
from bodyschema.interfaces.errors import BodyschemaError, ConfigError, RequestError, SourceError

EXAMPLE = Path(__file__).parents[2] / "examples" / "desk_arm" / "servos.toml"
ELBOW = ("--joint", "elbow_pitch")


class Emulator:
    """The desk arm's servos on a port, and the command."""

    def __init__(self, dry_run: DryRun, robot: Path) -> None:
        self.dry_run, self.robot = dry_run, robot

    def __call__(self, *words: str) -> int:
        """Return the exit code of `bodyschema servos` with these words."""
        try:
            command_line()(
                ["servos", *words, "--robot", str(self.robot)], exit_on_error=False, result_action="return_none"
            )
        except SystemExit as ended:
            return int(ended.code or 0)
        return 0

    def elbow(self, name: str) -> int:
        """Return the value of a register of the elbow's servo."""
        return self.dry_run.arm.servo("elbow_pitch")[name]

    @property
    def log(self) -> list[LoggedWrite]:
        """All lines."""
        file = self.robot.with_name("bus.state") / FILE
        return [msgspec.json.decode(line, type=LoggedWrite) for line in file.read_bytes().splitlines()]


@pytest.fixture
def emulator(tmp_path: Path, patient_host: None) -> Iterator[Emulator]:
    config = Config.load(EXAMPLE, {})
    port = tmp_path / "bus"
    motion = Motion(dict.fromkeys(config.robot.joints, lambda _: 0.2), "standing still")
    with open_emulator(config, port, motion, faults=["torque@elbow_pitch"], return_delay_s=5e-4, seed=0) as dry_run:
        yield Emulator(dry_run, emulator_robot_file(config, dry_run, port))


def test_dry_run_shows_table_and_writes_nothing(emulator, capsys) -> None:
    assert emulator("return_delay=0", *ELBOW, "--dry-run") == 0
    assert "elbow_pitch   3  return_delay (9)  250 (500 µs)  →  0 (0 µs)" in capsys.readouterr().out
    assert (emulator.elbow("return_delay"), emulator.elbow("torque")) == (250, 1)
    assert not emulator.robot.with_name("bus.state").exists()


def test_sdk_reads_the_written_settings(emulator) -> None:
    assert emulator("return_delay=0", "operating_mode=current", *ELBOW, "--yes") == 0
    port = sdk.PortHandler(str(emulator.robot.with_name("bus")))
    port.setBaudRate(1_000_000)
    found = [sdk.PacketHandler(2.0).read1ByteTxRx(port, 3, address)[0] for address in (9, 11, 64)]
    port.closePort()
    assert found == [0, 0, 0]


def test_each_write_is_logged_before_and_after(emulator) -> None:
    emulator("return_delay=0", *ELBOW, "--yes")
    assert [(line.old, line.new, line.state) for line in emulator.log] == [(250, 0, "begun"), (250, 0, "written")]


def test_undo_takes_back_one_command_after_the_other(emulator) -> None:
    emulator("return_delay=0", *ELBOW, "--yes")
    emulator("id=9", *ELBOW, "--yes")
    assert emulator("--undo", "--yes") == 0
    assert (emulator.elbow("id"), emulator.elbow("return_delay")) == (3, 0)
    assert emulator("--undo", "--yes") == 0
    assert emulator.elbow("return_delay") == 250
    with pytest.raises(ConfigError, match="nothing to take back"):
        emulator("--undo", "--yes")


def test_undo_skips_settings_changed_by_others(emulator, capsys) -> None:
    emulator("return_delay=0", *ELBOW, "--yes")
    emulator.dry_run.arm.servo("elbow_pitch")["return_delay"] = 7
    assert emulator("--undo", "--yes") == 0
    assert emulator.elbow("return_delay") == 7
    assert "left alone: elbow_pitch (ID 3): return_delay is 7" in capsys.readouterr().out


def test_a_rate_is_changed_and_taken_back(emulator) -> None:
    assert emulator("baud=57600", "--joint", "base_yaw", "--yes") == 0
    assert emulator.dry_run.arm.servo("base_yaw").baud == 57_600
    assert emulator("--port", str(emulator.robot.with_name("bus")), "--id", "1", "--baud", "57600") == 0
    assert emulator("--undo", "--yes") == 0
    assert emulator.dry_run.arm.servo("base_yaw").baud == 1_000_000


def test_zero_prints_current_ticks_and_writes_nothing(emulator, capsys) -> None:
    assert emulator("--zero", *ELBOW) == 0
    ticks = 2048 - round(0.2 * 4096 / (2 * 3.141592653589793))  # it counts against the joint
    assert f"elbow_pitch  zero_ticks = {ticks}" in capsys.readouterr().out
    assert emulator.elbow("homing_offset") == 0


def test_zero_in_the_servo_makes_here_the_zero(emulator) -> None:
    assert emulator("--zero", "--in-servo", *ELBOW, "--yes") == 0
    assert emulator.dry_run.arm.servo("elbow_pitch").position(0.0) == 2048


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("id=2", *ELBOW), "the ID 2 is taken"),
        (("id=9", "--bus", "arm"), "several servos cannot get one ID"),
        (("id=9", "return_delay=0", *ELBOW), "id has to be set alone"),
        (("torque=1", *ELBOW), "has no setting 'torque'"),
        (("position=1", *ELBOW), "has no setting 'position'"),
        (("return_delay=255", *ELBOW), "from 0 to 254"),
        (("baud=12345", *ELBOW), "Give one of 9600, 57600"),
        (("return_delay=0",), "no servos are named"),
        (("return_delay", *ELBOW), "Write NAME=VALUE"),
        (("return_delay=0", "--joint", "elbow"), "Did you mean 'elbow_pitch'"),
    ],
)
def test_invalid_settings_are_refused_and_nothing_is_written(emulator, words, said) -> None:
    with pytest.raises(BodyschemaError, match=said):
        emulator(*words, "--yes")
    assert emulator.elbow("torque") == 1


def test_a_servo_that_does_not_answer_is_named(emulator) -> None:
    emulator.dry_run.arm.chains["arm"].servos.pop(2)
    with pytest.raises(SourceError, match=r"'elbow_pitch' \(ID 3, XM430-W350\).*no answer"):
        emulator("return_delay=0", *ELBOW, "--yes")


def test_log_with_truncated_last_line_is_read(emulator) -> None:
    emulator("return_delay=0", *ELBOW, "--yes")
    log = ServoLog(emulator.robot.with_name("bus.state"))
    with log.file.open("ab") as stream:
        stream.write(b'{"utc":"2026')
    assert [entry.new for entry in log.to_undo()] == [0]


def test_settings_are_printed_as_json_too(emulator, capsys) -> None:
    assert emulator("--json", *ELBOW) == 0
    (servo,) = json.loads(capsys.readouterr().out)["servos"]
    assert (servo["joint"], servo["settings"]["return_delay"]["value"]) == ("elbow_pitch", 250)


@pytest.mark.parametrize("words", [("id=9", "--undo"), ("--zero", "--undo", *ELBOW), ("--in-servo",)])
def test_two_requests_at_once_are_refused(emulator, words) -> None:
    with pytest.raises(RequestError):
        emulator(*words)
