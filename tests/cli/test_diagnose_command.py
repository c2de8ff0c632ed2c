"""`bodyschema diagnose` at the command line: output, files and errors."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import sys
from pathlib import Path
from unittest import mock

import msgspec
import numpy as np
import pytest
from rich.console import Console
from walked import DESK_ARM, walked

from bodyschema.cli.main import main
from bodyschema.cli.terminal.diagnosis_view import view
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import Request, ZenohSession
from bodyschema.daemon.transport.wire import PairsReply, encode, pair_to_wire
from bodyschema.diagnosis.report.result import DiagnosisFile, Indistinguishable, Unexplained
from bodyschema.effects import Effect
from bodyschema.interfaces.records import Pair
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

FEW = ("--effects", "joint_scale,backlash")
KEYS = {
    "schema",
    "verdict",
    "pairs",
    "mean_mm",
    "rms_mm",
    "gain",
    "causes",
    "rejected",
    "unexplained",
    "advice",
    "hand_eye",
    "pose_covariance",
}
RMS_KEYS = {"nominal", "aligned", "geometry", "extended", "noise_floor"}
CAUSE_KEYS = {
    "effect", "where", "source", "parameters", "probability", "share_of_gain_percent", "indistinguishable_from",
    "evidence",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Ended:
    code: object
    out: str
    err: str


def diagnose(*arguments: object, columns: int = 80) -> Ended:
    out, err = io.StringIO(), io.StringIO()
    command = ["bodyschema", "diagnose", *map(str, arguments)]
    with (
        mock.patch.object(sys, "argv", command),
        mock.patch.dict(os.environ, {"COLUMNS": str(columns)}),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return Ended(ended.value.code or 0, out.getvalue(), err.getvalue())


def refused(*arguments: object) -> str:
    """Return the error line after the progress, with which the command fails."""
    ended = diagnose(*arguments)
    assert (ended.code, ended.out) == (1, "")
    line = ended.err.splitlines()[-1]
    assert line.startswith("bodyschema: ")
    return line


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return RobotDescription.load(DESK_ARM)


@pytest.fixture(scope="module")
def recording(robot) -> Recording:
    return walked(robot, Effect.at(robot, "joint_scale", robot.joints[2], values={"scale_error": 0.02}))


@pytest.fixture(scope="module")
def file(recording, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("recorded") / "walk.csv"
    recording.write_csv(file)
    return file


@pytest.fixture(scope="module")
def out(file, tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("out") / "found"


@pytest.fixture(scope="module")
def told(file, out) -> Ended:
    return diagnose(file, "--robot", DESK_ARM, *FEW, "--out", out)


@pytest.fixture(scope="module")
def found(told, out) -> DiagnosisFile:
    return msgspec.json.decode((out / "diagnosis.json").read_bytes(), type=DiagnosisFile)


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Path:
    """Return the empty folder in which the command is typed again."""
    return tmp_path_factory.mktemp("here")


@pytest.fixture(scope="module")
def again(file, here) -> Ended:
    """Return the same diagnosis as `told`, typed with the seed that is the default, for JSON and without --out."""
    with contextlib.chdir(here):
        return diagnose(file, "--robot", DESK_ARM, *FEW, "--seed", 0, "--json")


# --- output


def test_cause_is_stated_with_joint_and_number(told, robot) -> None:
    assert told.code == 0
    sentence = " ".join(told.out.split("Error on data")[0].split())
    assert "EXPLAINED" in sentence
    assert f"Joint {robot.joints[2]} turns 2" in sentence


def test_remedy_is_printed(told) -> None:
    assert "What to do" in told.out
    assert "Multiply what the encoder of" in told.out


def test_progress_goes_to_stderr_as_plain_text(told) -> None:
    assert "hypotheses" in told.err
    assert "\x1b" not in told.err
    assert "hypotheses" not in told.out


def test_everything_fits_80_columns(told) -> None:
    tables = told.out.split("Open ")[0]
    assert max(map(len, tables.splitlines())) <= 80


def test_json_goes_to_stdout_alone(again) -> None:
    assert json.loads(again.out)["verdict"] == "explained"


def test_diagnosis_json_has_the_keys_that_are_promised(told, out) -> None:
    contents = json.loads((out / "diagnosis.json").read_text())
    assert set(contents) >= KEYS
    assert set(contents["rms_mm"]) == set(contents["mean_mm"]) == RMS_KEYS
    assert set(contents["pairs"]) == {"total", "held_out", "outliers"}
    counted = {"with_outliers_percent", "with_outliers_ci95"}
    assert set(contents["gain"]) == {"from", "held_out_percent", "ci95", *counted}
    assert set(contents["causes"][0]) >= CAUSE_KEYS
    assert set(contents["causes"][0]["parameters"]["scale_error"]) == {"value", "ci95"}
    assert set(contents["rejected"][0]) >= {"effect", "where", "held_out_gain_percent", "p_value"}
    assert set(contents["unexplained"]) >= {"rms_mm", "depends_on", "p_value"}


def printed(file: DiagnosisFile) -> str:
    console = Console(file=io.StringIO(), width=80)
    console.print(view(file, [], timed=True))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_shared_alternative_of_two_causes_is_printed_once(found) -> None:
    (cause,) = found.causes[:1]
    wave = Indistinguishable("unexplained", None, None, "this_motion", 0.5, "another error of shoulder_pitch")
    twice = (msgspec.structs.replace(cause, rivals=(wave,)),) * 2
    assert printed(msgspec.structs.replace(found, causes=twice)).count("may be another error of shoulder_pitch") == 1


def test_each_verdict_begins_differently(found) -> None:
    heads = {
        "explained": "EXPLAINED",
        "nothing_found": "NOTHING FOUND",
        "undecided": "UNDECIDED",
        "unexplained": "NOT ALL EXPLAINED",
    }
    for verdict, head in heads.items():
        assert printed(msgspec.structs.replace(found, verdict=verdict)).startswith(f" {head} ")


def test_rival_causes_state_whether_motion_can_distinguish(found) -> None:
    rivals = (
        Indistinguishable("backlash", "wrist", None, "this_motion", 0.3),
        Indistinguishable("camera_pose", None, None, "any_motion", 0.2),
    )
    cause = msgspec.structs.replace(found.causes[0], rivals=rivals)
    text = " ".join(printed(msgspec.structs.replace(found, causes=(cause,))).split())
    assert "may be play of joint wrist (30 %); another motion can tell" in text
    assert "may be a wrong place of the camera (20 %); no motion tells them apart" in text


def test_unexplained_residual_is_reported_with_its_joints(found) -> None:
    left = Unexplained(1.25, ("elbow", "time"), 1e-9, ("link 2 bends",))
    text = " ".join(printed(msgspec.structs.replace(found, verdict="unexplained", unexplained=left)).split())
    assert "About 1.25 mm (RMS) is left" in text
    assert "elbow, time. Link 2 bends." in text


# --- files


def test_without_out_nothing_is_written(again, here, file) -> None:
    assert list(here.iterdir()) == []
    assert [other.name for other in file.parent.iterdir()] == [file.name]


def test_out_gets_the_three_files(told, out) -> None:
    assert {file.name for file in out.iterdir()} == {"diagnosis.json", "report.html", "extended.toml"}
    assert f"give it to any command as --robot {out / 'extended.toml'}; robot.toml is unchanged." in told.out


def test_nothing_is_found_with_extended_simulation_as_nominal(told, out, file) -> None:
    extended = json.loads(diagnose(file, "--robot", out / "extended.toml", *FEW, "--json").out)
    assert extended["verdict"] == "nothing_found"


def test_the_same_seed_gives_the_same_figures(told, out, again) -> None:
    assert json.loads(again.out) == json.loads((out / "diagnosis.json").read_text())


@pytest.mark.soak
def test_effects_that_are_excluded_are_not_looked_for(file) -> None:
    looked = json.loads(diagnose(file, "--robot", DESK_ARM, *FEW, "--exclude", "joint_scale", "--json").out)
    named = {row["effect"] for row in [*looked["causes"], *looked["rejected"]]}
    assert named <= {"backlash", "outliers"}


# --- the running sampler's pairs


class Sampler:
    """A fake sampler that serves its pairs."""

    def __init__(self, bus: ZenohSession, name: str, recording: Recording) -> None:
        assert recording.t is not None
        rows = zip(recording.t, recording.q, recording.x, strict=True)
        self.pairs = [Pair("one", k, 1, float(t), "utc", q, x, np.eye(3) * 9e-8) for k, (t, q, x) in enumerate(rows, 1)]
        bus.answer(Keys(name).pairs, self._answer)

    def _answer(self, request: Request) -> bytes:
        first = int(request.parameters["from"])
        page = [pair_to_wire(pair) for pair in self.pairs[first - 1 : first + 299]]
        return encode(PairsReply("one", len(self.pairs), page))


@pytest.fixture
def live_robot(tmp_path, endpoint, robot) -> Path:
    """Return the robot.toml of the desk arm with its own sampler."""
    (tmp_path / robot.robot.urdf).write_bytes(robot.tree.file.read_bytes())
    (tmp_path / "robot.toml").write_text(f'{DESK_ARM.read_text()}\n[zenoh]\nsampler = "{endpoint}"\n')
    return tmp_path / "robot.toml"


def test_the_running_samplers_pairs_are_diagnosed(live_robot, endpoint, recording) -> None:
    with ZenohSession(listen=endpoint) as bus:
        Sampler(bus, "desk_arm", recording)
        ended = diagnose("--live", "--robot", live_robot, *FEW, "--json")
    contents = json.loads(ended.out)
    assert contents["pairs"]["total"] == len(recording)
    assert [cause["effect"] for cause in contents["causes"]] == ["joint_scale"]


def test_live_diagnosis_reports_a_sampler_without_pairs(live_robot, endpoint, recording) -> None:
    with ZenohSession(listen=endpoint) as bus:
        Sampler(bus, "desk_arm", recording).pairs.clear()
        assert "the sampler has no samples yet" in refused("--live", "--robot", live_robot)


def test_live_diagnosis_reports_a_missing_sampler(live_robot) -> None:
    assert "nothing listens on" in refused("--live", "--robot", live_robot)


# --- refusals


def written(recording: Recording, folder: Path, **changes) -> Path:
    file = folder / "changed.csv"
    dataclasses.replace(recording, **changes).write_csv(file)
    return file


def test_a_recording_and_live_are_one_too_many(file) -> None:
    assert "one of the two" in refused(file, "--live", "--robot", DESK_ARM)


def test_neither_a_recording_nor_live_is_too_little() -> None:
    assert "one of the two" in refused("--robot", DESK_ARM)


def test_a_missing_file_is_named(tmp_path) -> None:
    assert str(tmp_path / "none.csv") in refused(tmp_path / "none.csv", "--robot", DESK_ARM)


@pytest.mark.parametrize("option", ["--effects", "--exclude"])
def test_unknown_effect_error_suggests_nearest_known_effect(file, option) -> None:
    line = refused(file, "--robot", DESK_ARM, option, "backlash,joint_ofset")
    assert "'joint_ofset'" in line
    assert "Did you mean 'joint_offset'?" in line


@pytest.mark.parametrize("option", ["--effects", "--exclude"])
def test_outliers_cannot_be_named_as_an_effect(file, option) -> None:
    assert "always looked for" in refused(file, "--robot", DESK_ARM, option, "outliers")


def test_nan_in_recording_error_names_line_and_column(file, tmp_path) -> None:
    lines = file.read_text().splitlines()
    cells = lines[9].split(",")
    cells[-1] = "nan"
    lines[9] = ",".join(cells)
    (tmp_path / "nan.csv").write_text("\n".join(lines) + "\n")
    line = refused(tmp_path / "nan.csv", "--robot", DESK_ARM)
    assert "line 10" in line
    assert "column z" in line


def test_a_recording_of_other_joints_is_refused(file, tmp_path) -> None:
    (tmp_path / "other.csv").write_text(file.read_text().replace("elbow_pitch", "knee", 1))
    assert "elbow_pitch" in refused(tmp_path / "other.csv", "--robot", DESK_ARM)


def test_degrees_are_seen(recording, tmp_path) -> None:
    file = written(recording, tmp_path, q=np.degrees(recording.q))
    assert "these look like degrees" in refused(file, "--robot", DESK_ARM)


def test_millimetres_are_seen(recording, tmp_path) -> None:
    file = written(recording, tmp_path, x=1e3 * recording.x)
    assert "these look like millimetres" in refused(file, "--robot", DESK_ARM)


@pytest.mark.parametrize(("unit", "factor"), [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)])
def test_times_in_another_unit_are_seen(recording, tmp_path, unit, factor) -> None:
    line = refused(written(recording, tmp_path, t=factor * recording.t), "--robot", DESK_ARM)
    assert f"these look like {unit}" in line
    assert f"divide by {factor:g}" in line


def test_reversed_joints_are_reported_together_without_output_folder(recording, tmp_path) -> None:
    file = written(recording, tmp_path, q=-recording.q)
    line = refused(file, "--robot", DESK_ARM, "--out", tmp_path / "found" / "here")
    assert "all joints count the other way" in line
    assert not (tmp_path / "found").exists()


@pytest.mark.parametrize("axis", [0, *(pytest.param(axis, marks=pytest.mark.soak) for axis in (1, 2))])
def test_positions_in_a_left_handed_frame_are_seen(recording, tmp_path, axis) -> None:
    x = recording.x * np.where(np.arange(3) == axis, -1.0, 1.0)
    assert "the positions are mirrored" in refused(written(recording, tmp_path, x=x), "--robot", DESK_ARM)


def test_a_mirrored_joint_is_seen(recording, tmp_path) -> None:
    file = written(recording, tmp_path, q=recording.q * [1, -1, 1, 1])
    assert "shoulder_pitch counts the other way" in refused(file, "--robot", DESK_ARM)


def test_exchanged_columns_are_seen(recording, tmp_path) -> None:
    file = written(recording, tmp_path, q=recording.q[:, [0, 2, 1, 3]])
    assert "the columns shoulder_pitch and elbow_pitch are exchanged" in refused(file, "--robot", DESK_ARM)


def test_positions_unrelated_to_the_arm_are_refused(recording, tmp_path) -> None:
    x = np.random.default_rng(9).permutation(recording.x)
    assert "hardly of this robot" in refused(written(recording, tmp_path, x=x), "--robot", DESK_ARM, *FEW)


def test_too_few_pairs_are_counted(recording, tmp_path) -> None:
    file = tmp_path / "few.csv"
    recording.rows(np.arange(12)).write_csv(file)
    assert "12 samples are too few" in refused(file, "--robot", DESK_ARM)


def test_latency_diagnosis_of_untimed_recording_is_refused(robot, tmp_path) -> None:
    file = tmp_path / "untimed.csv"
    walked(robot, timed=False).write_csv(file)
    line = refused(file, "--robot", DESK_ARM, "--effects", "camera_latency")
    assert "nothing to look for" in line
    assert "no times" in line


def test_unwritable_output_folder_fails_before_the_diagnosis(file, tmp_path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("")
    ended = diagnose(file, "--robot", DESK_ARM, *FEW, "--out", taken)
    assert ended.err.count("\n") == 1
    assert str(taken) in ended.err


def test_recording_without_joint_motion_is_refused(recording, tmp_path) -> None:
    file = tmp_path / "still.csv"
    n = len(recording)
    dataclasses.replace(
        recording, q=np.repeat(recording.q[:1], n, axis=0), x=np.repeat(recording.x[:1], n, axis=0)
    ).write_csv(file)
    assert "no joint ever moved" in refused(file, "--robot", DESK_ARM)


def test_excluding_every_requested_effect_is_refused(file) -> None:
    line = refused(file, "--robot", DESK_ARM, "--effects", "backlash", "--exclude", "backlash")
    assert "nothing to look for" in line


def test_nothing_is_found_in_the_simulations_own_output(robot, recording, tmp_path) -> None:
    file = tmp_path / "own.csv"
    dataclasses.replace(recording, x=robot.chain.positions(recording.q), cov=None).write_csv(file)
    ended = diagnose(file, "--robot", DESK_ARM)
    assert ended.code == 0
    assert "NOTHING FOUND" in ended.out
    assert "100" not in ended.out
