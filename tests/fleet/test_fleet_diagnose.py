"""Many recordings diagnosed on Dask: the faulty unit, isolated failures and a clean end."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import pytest
from hidden_units import DESK_ARM, unit

from bodyschema.cli.main import main
from bodyschema.diagnosis.report.result import Cause, DiagnosisFile, Errors, Gain, Interval, Pairs, Unexplained
from bodyschema.fleet.diagnosing import Diagnosed, Job, jobs
from bodyschema.fleet.summary import sentences, summary
from bodyschema.interfaces.errors import RecordingError, RequestError
from bodyschema.robot.description import RobotDescription

pytestmark = pytest.mark.skipif(
    find_spec("distributed") is None, reason="no Dask; to run it: pip install -e '.[fleet]'"
)


def fleet(*words: object) -> tuple[object, str, str]:
    """Return exit code, standard output and standard error of `bodyschema fleet`."""
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["bodyschema", "fleet", *map(str, words)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return ended.value.code or 0, out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a nominal unit, one whose elbow turns 2 % farther than it reads, and a file that is not a recording."""
    folder, robot = tmp_path_factory.mktemp("units"), RobotDescription.load(DESK_ARM)
    unit(robot, 1).write_csv(folder / "left.csv")
    unit(robot, 2, scaled=(2, 1.02)).write_csv(folder / "right.csv")
    (folder / "broken.csv").write_text("nonsense\n1\n")
    return folder


@pytest.fixture(scope="module")
def told(folder: Path) -> tuple[object, str, str]:
    few = ("--effects", "joint_scale")
    return fleet("--from", folder, "--robot", DESK_ARM, "--out", folder / "out", *few, "--workers", "1", "--json")


@pytest.fixture(scope="module")
def rows(told: tuple[object, str, str]) -> dict[str, dict]:
    assert told[0] == 0
    return {row["name"]: row for row in json.loads(told[1])["rows"]}


def test_hidden_fault_is_named_with_unit_and_joint(rows: dict[str, dict]) -> None:
    assert rows["right"]["verdict"] == "explained"
    (cause,) = rows["right"]["causes"]
    assert cause.startswith("joint_scale at elbow_pitch: scale +")
    assert float(cause.split("+")[1].split(" ")[0]) == pytest.approx(2.0, abs=0.1)


def test_a_unit_without_a_fault_has_none(rows: dict[str, dict]) -> None:
    assert rows["left"]["verdict"] == "nothing_found"


def test_failing_recording_is_reported_beside_others(rows: dict[str, dict]) -> None:
    assert "there is no column for the joint" in rows["broken"]["error"]
    assert len(rows) == 3


def test_unit_fault_is_separated_from_type_fault(told: tuple[object, str, str]) -> None:
    (found,) = json.loads(told[1])["types"]
    assert (sorted(found["well"]), list(found["off"])) == (["left"], ["right"])


def test_each_robot_has_a_folder_with_its_report(folder: Path, rows: dict[str, dict]) -> None:
    assert {file.parent.name for file in (folder / "out").glob("*/report.html")} == {"left", "right"}


def test_what_was_found_loads_as_a_robot_s_description(folder: Path, rows: dict[str, dict]) -> None:
    assert RobotDescription.load(folder / "out" / "right" / "extended.toml").joints


def test_progress_prints_line_per_finished_recording(told: tuple[object, str, str]) -> None:
    assert [line.split(":")[0] for line in told[2].splitlines()] == [f"{k} of 3" for k in range(1, 4)]


def test_silent_scheduler_error_names_address(folder: Path, endpoint: str) -> None:
    address = endpoint.replace("tcp/", "tcp://")
    with mock.patch("bodyschema.fleet.diagnosing._Settings.connect_limit_s", 0.5):
        code, _, err = fleet(folder / "left.csv", "--robot", DESK_ARM, "--scheduler", address)
    assert code == 1
    assert f"no Dask scheduler answers on {address}" in err


def test_nothing_named_is_refused() -> None:
    with pytest.raises(RequestError, match="nothing to diagnose"):
        jobs([], None, None)


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no recording is in it"):
        jobs([], tmp_path, None)


def test_equally_named_recordings_are_distinguished_by_folder(tmp_path: Path) -> None:
    files = [tmp_path / name / "pairs.csv" for name in ("left", "right")]
    assert [job.name for job in jobs(files, None, DESK_ARM)] == ["left_pairs", "right_pairs"]


def test_the_robot_beside_a_recording_is_taken(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").touch()
    (job,) = jobs([tmp_path / "pairs.csv"], None, None)
    assert job.robot == tmp_path / "robot.toml"


def result(name: str, *effects: str) -> Diagnosed:
    causes = tuple(
        Cause(
            effect=effect,
            where="elbow" if effect.startswith("joint") else None,
            source=None,
            parameters={"offset_rad": Interval(0.02, (0.019, 0.021))},
            probability=0.99,
            share_of_gain_percent=100.0,
            held_out_gain_percent=50.0,
            indistinguishable_from=(),
            rivals=(),
            evidence="",
        )
        for effect in effects
    )
    errors = Errors(2.0, 2.0, 2.0, 1.0, 1.0)
    file = DiagnosisFile(
        verdict="explained" if causes else "nothing_found",
        sentence="",
        pairs=Pairs(100, 30, 0),
        rms_mm=errors,
        mean_mm=errors,
        gain=Gain(50.0, (45.0, 55.0)),
        causes=causes,
        rejected=(),
        unexplained=Unexplained(0.0, (), 1.0),
        advice=(),
        limitations=(),
    )
    return Diagnosed(Job(name, Path(name), Path()), "arm", ("waist", "elbow"), file)


def test_common_fault_is_attributed_to_description() -> None:
    (found,) = summary([result(name, "joint_offset") for name in "abc"] + [result("d")]).types
    assert found.off == {}
    assert "3 of 4 units have joint_offset at elbow (a, b, c)" in " ".join(sentences(found))


def test_where_a_tool_sits_is_each_unit_s_own() -> None:
    (found,) = summary([result(name, "tool_offset") for name in "abc"]).types
    assert (found.shared, sorted(found.off)) == ((), ["a", "b", "c"])
