"""`bodyschema export` of a robot with its effects."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_arm import write_small_arm

from bodyschema.cli.main import app
from bodyschema.cli.recordings.synthesis import simulated
from bodyschema.effects import Effect, Simulation, load_simulation, write_extended
from bodyschema.effects.exports import write_correction
from bodyschema.interfaces.errors import ConfigError, RequestError
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription


@pytest.fixture
def extended(tmp_path: Path) -> Path:
    robot = RobotDescription.load(write_small_arm(tmp_path))
    joint = robot.joints[0]
    effects = [("joint_offset", [0.05]), ("backlash", [0.02]), ("settling", [0.1, 0.0])]
    simulation = Simulation(robot, tuple(Effect.at(robot, name, joint, values=values) for name, values in effects))
    return write_extended(simulation, tmp_path / "found", "made by a test")


@pytest.fixture
def measured(extended: Path) -> Path:
    simulation = load_simulation(extended)
    robot = simulation.robot
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (30, len(robot.joints)))
    recording = simulated(simulation, Recording(robot.joints, q, np.zeros((30, 3))))
    recording.write_csv(extended.parent / "measured.csv")
    return extended.parent / "measured.csv"


def export(*arguments: object) -> None:
    app(["export", *map(str, arguments)], result_action="return_value")


@pytest.mark.parametrize("ending", ["xml", "urdf"])
def test_gain_of_the_file_itself_is_printed(extended, measured, tmp_path, capsys, ending) -> None:
    pytest.importorskip("mujoco")
    export(extended, tmp_path / f"model.{ending}", "--measured", measured)
    told = capsys.readouterr().out
    rows = {line.split("│")[1].strip(): line.split("│") for line in told.splitlines() if line.count("│") > 3}
    [own] = [cells for name, cells in rows.items() if name.startswith("model.")]
    assert float(rows["bodyschema simulate"][2]) == 0.0
    assert 0.0 < float(own[2]) < float(rows["nominal"][2])
    assert 0.0 < float(own[4]) < 100.0
    assert "not in the file: settling" in told


def test_json_has_file_gaps_and_errors_in_si(extended, measured, tmp_path, capsys) -> None:
    export(extended, tmp_path / "arm.txt", "--measured", measured, "--json")
    told = json.loads(capsys.readouterr().out)
    assert told["file"] == str(tmp_path / "arm.txt")
    assert any("settling" in sentence for sentence in told["not_in_it"])
    assert [row["model"] for row in told["errors"]][:2] == ["nominal", "bodyschema simulate"]
    assert told["errors"][1]["rms_m"] == 0.0 < told["errors"][0]["rms_m"] < 1.0


def rms_mm(told: str) -> list[float]:
    return [float(line.split("│")[2]) for line in told.splitlines() if line.count("│") > 3]


def test_correction_gain_matches_the_example_reader(extended, measured, tmp_path, capsys) -> None:
    export(extended, tmp_path / "correction.json", "--measured", measured)
    told = capsys.readouterr().out
    recording = Recording.read(measured, load_simulation(extended).robot.joints)
    lines = "\n".join(" ".join(map(repr, q)) for q in recording.q.tolist())
    reader = Path(__file__).parents[2] / "examples" / "correction" / "correction.py"
    command = [sys.executable, str(reader), str(tmp_path / "correction.json")]
    done = subprocess.run(command, input=lines, capture_output=True, text=True, check=True)
    rows = np.array([line.split() for line in done.stdout.splitlines()], dtype=np.float64)
    missed = rows[:, recording.q.shape[1] :].reshape(-1, 3, 4)[:, :, 3] - recording.x
    assert rms_mm(told)[2] == pytest.approx(1e3 * np.sqrt(np.square(missed).sum(axis=1).mean()), abs=6e-4)
    assert rms_mm(told)[2] > 0.0  # the play of the first row is known to the simulation alone


def test_correction_gain_is_computed_from_the_file(extended, measured, tmp_path, capsys, monkeypatch) -> None:
    def spoilt(simulation: Simulation, file: Path, heading: str, covariance: object) -> list[str]:
        return write_correction(Simulation(simulation.robot), file, heading)

    monkeypatch.setattr("bodyschema.cli.terminal.robot_export.write_correction", spoilt)
    export(extended, tmp_path / "correction.json", "--measured", measured)
    nominal, _, own = rms_mm(capsys.readouterr().out)
    assert own == nominal


def test_correction_contains_the_covariance_of_the_diagnosis(extended, tmp_path, capsys) -> None:
    export(extended, tmp_path / "without.json")
    assert "not in it: the pose's covariance" in " ".join(capsys.readouterr().out.split())
    covariance = np.eye(6).ravel().tolist()
    extended.with_name("diagnosis.json").write_text(json.dumps({"pose_covariance": covariance}))
    export(extended, tmp_path / "with.json")
    found = [json.loads((tmp_path / name).read_text())["pose_covariance"] for name in ("without.json", "with.json")]
    assert found == [None, covariance]
    extended.with_name("diagnosis.json").write_text('{"pose_covariance": [1, 2]}')
    with pytest.raises(ConfigError, match="Diagnose again"):
        export(extended, tmp_path / "wrong.json")


def test_gain_of_settings_of_drivers_is_printed(extended, measured, tmp_path, capsys) -> None:
    export(extended, tmp_path / "drivers.txt", "--measured", measured)
    told = capsys.readouterr().out
    nominal, _, drivers = rms_mm(told)
    assert drivers < nominal
    assert "zeros and scales of drivers.txt" in told


def test_encoder_jump_exports_as_driver_zero(extended, measured, tmp_path, capsys) -> None:
    export(extended, tmp_path / "drivers.txt", "--measured", measured)
    as_offset = rms_mm(capsys.readouterr().out)
    text = extended.read_text().replace('"joint_offset"', '"encoder_jump"')
    extended.write_text(text.replace("offset_rad = 0.05", "jump_rad = 0.05\nt0 = -1.0"))
    export(extended, tmp_path / "jumped.txt", "--measured", measured)
    assert rms_mm(capsys.readouterr().out)[2] == as_offset[2]


def test_settings_of_drivers_that_are_wrong_gain_nothing(extended, measured, tmp_path, capsys) -> None:
    extended.write_text(extended.read_text().replace("offset_rad = 0.05", "offset_rad = 0.5"))
    export(extended, tmp_path / "drivers.txt", "--measured", measured)
    nominal, _, drivers = rms_mm(capsys.readouterr().out)
    assert drivers > nominal


def test_small_errors_within_tolerance_are_counted_apart(extended, tmp_path, capsys) -> None:
    simulation = load_simulation(extended)
    robot = simulation.robot
    small = Effect.at(robot, "joint_offset", robot.joints[1], values=[1e-5])
    again = write_extended(simulation.with_background([small]), tmp_path / "again", "made by a test")
    export(again, tmp_path / "model.urdf")
    assert "with 3 effects and 1 small error within tolerance written" in capsys.readouterr().out


def test_export_without_mujoco_writes_file_without_replay(extended, measured, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    export(extended, tmp_path / "model.xml", "--measured", measured)
    assert (tmp_path / "model.xml").exists()
    assert "pip install mujoco" in capsys.readouterr().out


@pytest.mark.parametrize(("target", "what"), [("model.csv", "end in"), ("none/model.xml", "no folder")])
def test_wrong_targets_are_refused(extended, tmp_path, target, what) -> None:
    with pytest.raises(ConfigError, match=what):
        export(extended, tmp_path / target)


def test_existing_files_need_force(extended, tmp_path) -> None:
    out = tmp_path / "model.xml"
    export(extended, out)
    with pytest.raises(ConfigError, match="--force"):
        export(extended, out)
    export(extended, out, "--force")


def test_measured_goes_with_a_robot(measured, tmp_path) -> None:
    with pytest.raises(RequestError, match="extended"):
        export(measured, tmp_path / "pairs.csv", "--measured", measured)
