"""`bodyschema emulate` and the wiring behind it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from bodyschema.cli.hardware.emulator_run import FAULTS, EmulatorRun
from bodyschema.cli.main import app
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.wiring import open_joints
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError

EXAMPLE = Path(__file__).parents[2] / "examples" / "desk_arm"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with an arm of servos in it."""
    return Path(shutil.copytree(EXAMPLE, tmp_path / "arm"))


@pytest.fixture
def config(folder: Path) -> Config:
    return Config.load(folder / "servos.toml", {})


EACH = pytest.mark.parametrize("file", ["servos.toml", "feetech.toml", "encoders.toml"])


def test_written_robot_file_keeps_servos_with_emulator_port(config, folder) -> None:
    with EmulatorRun(config, folder / "bus") as run:
        written = Config.load(run.robot_file, {})
    assert written.tables.drivers.dynamixel is not None
    assert written.tables.drivers.dynamixel.servos == config.tables.drivers.dynamixel.servos
    assert written.tables.drivers.dynamixel.buses["arm"].port == str(folder / "bus")
    assert written.robot.joints == config.robot.joints
    assert written.state_dir != config.state_dir


@pytest.mark.usefixtures("patient_host")
@EACH
def test_driver_reads_emulator_through_the_written_file(file, folder) -> None:
    config = Config.load(folder / file, {})
    with EmulatorRun(config, folder / "bus") as run:
        with open_joints(Config.load(run.robot_file, {}), SystemClock()) as joints:
            reading = next(told for _ in range(100) if (told := joints.read(0.1)) is not None)
        assert run.count > 0
    assert reading.q == pytest.approx(np.zeros(4), abs=0.01)


@EACH
def test_emulator_leaves_nothing_behind(file, folder) -> None:
    config = Config.load(folder / file, {})
    before = set(folder.iterdir())
    with EmulatorRun(config, folder / "bus"):
        pass
    assert set(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("file", "what", "command"),
    [
        ("servos.toml", "4 servos", "scan"),
        ("feetech.toml", "4 servos", "watch joints"),
        ("encoders.toml", "4 encoders", "doctor"),
    ],
)
def test_introduction_names_the_commands_to_type(file, what, command, folder) -> None:
    with EmulatorRun(Config.load(folder / file, {}), folder / "bus") as run:
        said = "\n".join(run.introduction())
    assert f"desk_arm: {what} on {folder / 'bus'} at " in said
    assert f"bodyschema {command} --robot {folder / 'bus.toml'}" in said


def test_requested_fault_happens_at_its_time(config, folder) -> None:
    time = [0.0]
    with EmulatorRun(config, folder / "bus", faults=["unplug"], now=lambda: time[0]) as run:
        assert list(run.due()) == []
        time[0] = 10.5
        assert list(run.due()) == ["unplugged"]
        assert not (folder / "bus").is_symlink()
        time[0] = 13.5
        assert list(run.due()) == ["plugged in again"]
        assert (folder / "bus").is_symlink()


def test_existing_file_at_the_port_path_is_kept(config, folder) -> None:
    (folder / "bus").write_text("precious")
    with pytest.raises(ConfigError, match="is there already"):
        EmulatorRun(config, folder / "bus")
    assert (folder / "bus").read_text() == "precious"


def test_emulator_that_runs_keeps_its_port(config, folder) -> None:
    with EmulatorRun(config, folder / "bus"):
        terminal = (folder / "bus").readlink()
        with pytest.raises(ConfigError, match="another emulator has this port"):
            EmulatorRun(config, folder / "bus")
        assert (folder / "bus").readlink() == terminal


def test_stale_port_of_a_killed_emulator_is_replaced(config, folder) -> None:
    (folder / "bus").symlink_to("/dev/pts/99999")
    with EmulatorRun(config, folder / "bus"):
        assert (folder / "bus").exists()


def test_existing_foreign_robot_toml_is_kept(config, folder) -> None:
    (folder / "bus.toml").write_text("precious")
    with pytest.raises(ConfigError, match="no emulator wrote it"), EmulatorRun(config, folder / "bus"):
        pass
    assert (folder / "bus.toml").read_text() == "precious"


def test_missing_servos_error_names_the_table_to_add(folder) -> None:
    with pytest.raises(ConfigError, match=r"no servos are configured.*\[drivers\.dynamixel\]"):
        EmulatorRun(Config.load(folder / "robot.toml", {}), folder / "bus")


def test_every_fault_is_listed(capsys) -> None:
    app(["emulate", "--list-faults"], exit_on_error=False, result_action="return_value")
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(FAULTS)
