from __future__ import annotations

import contextlib
import json
import sqlite3
import sys
from pathlib import Path

import numpy as np
import pytest
import warm
from small_arm import JOINTS, ROBOT, URDF, write_small_arm

from bodyschema.cli.main import app
from bodyschema.interfaces.errors import ConfigError, RecordingError, StoreError
from bodyschema.interfaces.records import MarkerFix
from bodyschema.recordings.mcap_export import write_mcap
from bodyschema.recordings.recording import Recording
from bodyschema.recordings.store.store import PairStore, Session


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    return write_small_arm(tmp_path)


@pytest.fixture
def recording() -> Recording:
    rng = np.random.default_rng(2)
    roots = rng.normal(size=(4, 3, 3))
    cov = roots @ roots.swapaxes(1, 2) + np.eye(3)
    return Recording(
        JOINTS,
        rng.normal(size=(4, 2)),
        rng.normal(size=(4, 3)),
        t=np.array([10.0, 10.1, 2.0, 2.1]),
        cov=(cov + cov.swapaxes(1, 2)) / 2,
        segment=np.array([1, 1, 2, 2]),
    )


@pytest.fixture
def store(tmp_path: Path):
    session = Session(joints=JOINTS, started_utc="", robot_toml=ROBOT, urdf=URDF, config="{}", version="1", host="here")
    with PairStore(tmp_path / "pairs.sqlite", session) as store:
        yield store


def export(*arguments: object) -> None:
    app(["export", *map(str, arguments)], result_action="return_value")


def messages(file: Path, topic: str) -> list[tuple[int, dict]]:
    make_reader = pytest.importorskip("mcap.reader").make_reader
    with file.open("rb") as stream:
        return [
            (message.log_time, json.loads(message.data))
            for _, _, message in make_reader(stream, validate_crcs=True).iter_messages(topics=[topic])
        ]


def test_mcap_holds_every_number_of_every_row(tmp_path: Path, recording: Recording) -> None:
    pytest.importorskip("mcap")
    write_mcap(recording, tmp_path / "a.mcap")
    table = recording.to_table()
    rows = messages(tmp_path / "a.mcap", "/pair")
    assert [list(row.values()) for _, row in rows] == table.values.tolist()
    assert [tuple(row) for _, row in rows] == [table.names] * 4


def test_mcap_stores_marker_as_foxglove_pose(tmp_path: Path, recording: Recording) -> None:
    make_reader = pytest.importorskip("mcap.reader").make_reader
    write_mcap(recording, tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as stream:
        schema, channel, message = next(make_reader(stream).iter_messages(topics=["/marker"]))
    assert (schema.name, schema.encoding, channel.message_encoding) == ("foxglove.PoseInFrame", "jsonschema", "json")
    assert json.loads(schema.data)["properties"]["timestamp"]["title"] == "time"
    pose = json.loads(message.data)["pose"]
    assert list(pose["position"].values()) == recording.x[0].tolist()
    assert list(pose["orientation"].values()) == [0, 0, 0, 1]


def test_mcap_times_increase_across_a_clock_reset(tmp_path: Path, recording: Recording) -> None:
    pytest.importorskip("mcap")
    write_mcap(recording, tmp_path / "a.mcap")
    times = np.array([time for time, _ in messages(tmp_path / "a.mcap", "/pair")])
    assert (np.diff(times) > 0).all()
    assert times[0] == 10_000_000_000


def test_mcap_rejects_oversized_time_before_writing(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    late = Recording(JOINTS, np.zeros((1, 2)), np.zeros((1, 3)), t=np.array([1e12]))
    with pytest.raises(RecordingError, match="nanoseconds"):
        write_mcap(late, tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()


def test_without_the_extra_the_remedy_names_it(tmp_path: Path, recording: Recording, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(RecordingError, match=r"bodyschema\[export\]"):
        write_mcap(recording, tmp_path / "a.mcap")


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_recording_survives_the_way_through_another_format(tmp_path, robot, recording, ending) -> None:
    pytest.importorskip("pyarrow")
    recording.write_csv(tmp_path / "a.csv")
    export(tmp_path / "a.csv", tmp_path / f"b.{ending}", "--robot", robot)
    assert Recording.read(tmp_path / f"b.{ending}", JOINTS).to_table().values.tobytes() == (
        recording.to_table().values.tobytes()
    )


def test_a_recording_becomes_mcap(tmp_path: Path, robot: Path, recording: Recording) -> None:
    recording.write_csv(tmp_path / "a.csv")
    export(tmp_path / "a.csv", tmp_path / "a.mcap", "--robot", robot)
    assert len(messages(tmp_path / "a.mcap", "/pair")) == len(recording)


def test_open_store_is_exported_without_robot_toml(tmp_path: Path, store: PairStore, capsys) -> None:
    fix = MarkerFix(1.5, np.array([1.0, 2, 3]), np.eye(3) * 1e-6, (1.0, 2.0, 3.0, 4.0))
    store.append(7, "2026-01-01T00:00:00Z", np.array([0.1, 0.2]), fix)
    export(tmp_path / "pairs.sqlite", tmp_path / "a.csv")
    recording = Recording.read(tmp_path / "a.csv", JOINTS)
    assert recording.q.tolist() == [[0.1, 0.2]]
    assert recording.centres_px is not None
    assert recording.centres_px.tolist() == [[1, 2, 3, 4]]
    assert "1 samples" in capsys.readouterr().out


def test_json_has_the_number_of_pairs(tmp_path: Path, store: PairStore, capsys) -> None:
    fix = MarkerFix(1.5, np.array([1.0, 2, 3]), np.eye(3) * 1e-6, (1.0, 2.0, 3.0, 4.0))
    store.append(7, "2026-01-01T00:00:00Z", np.array([0.1, 0.2]), fix)
    export(tmp_path / "pairs.sqlite", tmp_path / "a.csv", "--json")
    told = json.loads(capsys.readouterr().out)
    assert (told["file"], told["pairs"]) == (str(tmp_path / "a.csv"), 1)


def test_export_reports_unreadable_pairs(tmp_path: Path, store: PairStore, caplog) -> None:
    for k in range(4):
        fix = MarkerFix(1.5 + k, np.array([1.0, 2, 3]), np.eye(3) * 1e-6)
        store.append(7, "2026-01-01T00:00:00Z", np.array([0.1, 0.2]), fix)
    with contextlib.closing(sqlite3.connect(store.file)) as connection:
        connection.execute("UPDATE pairs SET t = t + 1 WHERE seq IN (2, 4)")
        connection.commit()
    export(store.file, tmp_path / "a.csv")
    assert len(Recording.read(tmp_path / "a.csv", JOINTS)) == 2
    assert f"2 samples of {store.file} cannot be read" in caplog.text
    assert "(numbers 2, 4)" in caplog.text


def test_empty_store_export_is_rejected(tmp_path: Path, store: PairStore) -> None:
    with pytest.raises(RecordingError, match="the store has no samples"):
        export(tmp_path / "pairs.sqlite", tmp_path / "a.csv")


def test_exporting_a_missing_store_creates_no_file(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no store"):
        export(tmp_path / "pairs.sqlite", tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []


def test_existing_file_is_kept_unless_forced(tmp_path: Path, robot: Path, recording: Recording) -> None:
    recording.write_csv(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("precious")
    with pytest.raises(RecordingError, match="there already"):
        export(tmp_path / "a.csv", tmp_path / "b.csv", "--robot", robot)
    assert (tmp_path / "b.csv").read_text() == "precious"
    export(tmp_path / "a.csv", tmp_path / "b.csv", "--robot", robot, "--force")
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "a.csv").read_bytes()


@pytest.mark.parametrize(("out", "says"), [("b.txt", "recordings end in"), ("nowhere/b.csv", "no folder")])
def test_an_impossible_target_is_refused(tmp_path, robot, recording, out, says) -> None:
    recording.write_csv(tmp_path / "a.csv")
    with pytest.raises(RecordingError, match=says):
        export(tmp_path / "a.csv", tmp_path / out, "--robot", robot)


def test_an_unreadable_recording_leaves_nothing_behind(tmp_path: Path, robot: Path) -> None:
    (tmp_path / "a.csv").write_text("waist,shoulder,x,y,z\n0,0,1,2,3\n0,0,1,nan,3\n")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(RecordingError, match="line 3, column y"):
        export(tmp_path / "a.csv", tmp_path / "b.csv", "--robot", robot)
    assert sorted(tmp_path.iterdir()) == before


def test_failing_command_exits_1_with_one_line(tmp_path: Path, robot: Path) -> None:
    source = tmp_path / "a.csv"
    source.write_text("waist,shoulder,x,y,z\n0,0,1,2,3\n0,0,1,two,3\n")
    ended = warm.run("-m", "bodyschema", "export", source, tmp_path / "b.csv", "--robot", robot)
    assert ended.returncode == 1
    assert ended.stderr == (
        f"bodyschema: {source}, line 3, column y: 'two' is not a number. Write it like -0.5 or 1e-3, without quotes\n"
    )


def test_a_write_that_fails_leaves_nothing_behind(tmp_path: Path, robot: Path) -> None:
    late = "t,waist,shoulder,x,y,z\n1e12,0,0,1,2,3\n"
    (tmp_path / "a.csv").write_text(late)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(RecordingError, match="nanoseconds"):
        export(tmp_path / "a.csv", tmp_path / "b.mcap", "--robot", robot)
    assert sorted(tmp_path.iterdir()) == before


def test_a_recording_without_robot_toml_asks_for_it(tmp_path: Path, recording: Recording) -> None:
    recording.write_csv(tmp_path / "a.csv")
    with pytest.raises(ConfigError, match="no such file"):
        export(tmp_path / "a.csv", tmp_path / "b.csv", "--robot", tmp_path / "robot.toml")
