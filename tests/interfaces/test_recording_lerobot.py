"""LeRobotDatasets as the joint side of recordings, in the layouts 2.1 and 3.0."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from lerobot_datasets import write_dataset

from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings.lerobot_dataset import LeRobotUnits, read_lerobot_dataset
from bodyschema.recordings.tracks import MarkerTrack
from bodyschema.robot.lerobot import ARMS, JointServo, MotorCalibration, Unit

pytest.importorskip("pyarrow")

MOTORS = tuple(ARMS["so101"].models)
JOINTS = ARMS["so101"].joints
CALIBRATION = {
    name: MotorCalibration(k + 1, 0, 100 * k - 250, 800 + 10 * k, 3300 - 7 * k) for k, name in enumerate(MOTORS)
}
SERVOS = [JointServo(name, "feetech", 1, CALIBRATION[name].middle) for name in JOINTS]
FPS, FRAMES, EPISODES = 30, 60, 2


def path(t: np.ndarray, episode: int) -> np.ndarray:
    return np.sin(np.outer(t, np.arange(1, 7)) * 0.3 + episode)


def dataset(folder: Path, version: str, unit: Unit, **told: object) -> Path:
    """Write a dataset of two episodes along `path`."""
    t = np.arange(FRAMES) / FPS
    episodes = [(t, path(t, episode)) for episode in range(EPISODES)]
    return write_dataset(folder, version, unit, CALIBRATION, episodes, **told)


def marker() -> MarkerTrack:
    t = np.tile(np.arange(0.05, 1.9, 0.1), EPISODES)
    run = np.repeat(np.arange(EPISODES), len(t) // EPISODES)
    return MarkerTrack(t, np.column_stack([t, t, t]), run)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("unit", ["degrees", "range_m100_100"])
def test_angles_are_those_of_the_arm(version, unit, tmp_path) -> None:
    source = dataset(tmp_path / "set", version, unit)
    read = read_lerobot_dataset(source, LeRobotUnits(CALIBRATION, SERVOS, unit), marker())
    expected = np.concatenate([path(np.asarray(read.t)[read.segment == e], e)[:, :5] for e in range(EPISODES)])
    assert read.q == pytest.approx(expected, abs=1e-3)  # between frames 33 ms apart


def test_units_that_nothing_shows_are_asked_about(tmp_path) -> None:
    source = dataset(tmp_path / "set", "v3.0", "degrees")
    with pytest.raises(RecordingError, match=r"may be degrees or -100…100.*--lerobot-unit"):
        read_lerobot_dataset(source, LeRobotUnits(CALIBRATION, SERVOS), marker())


def test_motors_under_a_heading_are_found(tmp_path) -> None:
    source = dataset(tmp_path / "set", "v2.1", "degrees", names={"motors": list(MOTORS)})
    assert len(read_lerobot_dataset(source, LeRobotUnits(CALIBRATION, SERVOS, "degrees"), marker())) == 38


@pytest.mark.parametrize(
    ("info", "told"),
    [({"robot_type": "so100"}, "before version 0.3"), ({"codebase_version": "v2.0"}, "v2.1 and v3.0 are read")],
)
def test_older_datasets_are_refused(info, told, tmp_path) -> None:
    source = dataset(tmp_path / "set", "v2.1", "degrees", **info)
    with pytest.raises(RecordingError, match=told):
        read_lerobot_dataset(source, LeRobotUnits(CALIBRATION, SERVOS, "degrees"), marker())


def test_motors_of_another_arm_are_named(tmp_path) -> None:
    source = dataset(tmp_path / "set", "v2.1", "degrees", names=["a.pos", "b.pos"])
    with pytest.raises(RecordingError, match=r"has no motor shoulder_pan, .*; it has a, b"):
        read_lerobot_dataset(source, LeRobotUnits(CALIBRATION, SERVOS, "degrees"), marker())


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ({"timestamp": [0.0, float("nan")]}, "row 2 has a number that is missing or not finite"),
        ({"episode_index": [None, 0]}, "row 1 has a number that is missing or not finite"),
        ({"observation.state": [{"a": 1.0}] * 2}, "is no data of a LeRobotDataset"),
        ({"episode_index": [None, None]}, "is no data of a LeRobotDataset"),
        ({"timestamp": [], "episode_index": [], "observation.state": None}, "the dataset has no rows"),
    ],
)
def test_data_that_are_none_are_refused(columns, told, tmp_path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    source = dataset(tmp_path / "set", "v3.0", "degrees")
    (file,) = source.rglob("*.parquet")
    state = pa.array([[1.0] * len(MOTORS)] * 2, type=pa.list_(pa.float32()))
    told_columns = {"observation.state": state, "timestamp": [0.0, 0.1], "episode_index": [0, 0]} | columns
    if columns.get("observation.state", ...) is None:
        told_columns["observation.state"] = state[:0]
    pq.write_table(pa.table(told_columns), file)
    with pytest.raises(RecordingError, match=told):
        read_lerobot_dataset(source, LeRobotUnits(CALIBRATION, SERVOS, "degrees"), marker())


def test_more_rows_than_are_read_are_refused_unread(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.recordings.columns.ColumnLimits.max_numbers", 100)
    source = dataset(tmp_path / "set", "v3.0", "degrees")
    with pytest.raises(RecordingError, match="there are more than 12 rows with the files before it"):
        read_lerobot_dataset(source, LeRobotUnits(CALIBRATION, SERVOS, "degrees"), marker())
