"""The joints of a LeRobotDataset (Parquet, layouts 2.1 and 3.0), and the location of its videos.

Needs the extra `export`. Times are those of the dataset, which start at 0 in each episode.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bodyschema.interfaces.errors import RecordingError
from bodyschema.robot.lerobot import Calibrations, JointServo, Unit
from bodyschema.robot.limited import FileLimits, bounded_memory, opened, read_at_most

from .columns import ColumnLimits
from .parquet_file import MAX_BYTES, arrow_modules
from .recording import Recording
from .tracks import JointTrack, MarkerTrack, joined

INFO = Path("meta") / "info.json"
STATE = "observation.state"
_WHAT = "a LeRobotDataset"
_COLUMNS = (STATE, "timestamp", "episode_index")
# Robots of LeRobot from version 0.3 on are called so; before, angles were counted from another pose.
_NEW = ("_follower", "_leader")
BODY_UNITS: tuple[Unit, ...] = ("degrees", "range_m100_100")


@dataclass(frozen=True)
class LeRobotUnits:
    """Conversion of a dataset's readings to angles."""

    motors: Calibrations  # LeRobot's calibration of the arm with which the dataset was recorded
    servos: Sequence[JointServo]  # the joints, in the order of q
    unit: Unit | None = None  # of the readings; None: inferred from large readings


@dataclass(frozen=True)
class VideoPart:
    """The part of a video file that shows one episode."""

    file: Path
    episode: int
    # begin_s, end_s: from the first frame of the file
    begin_s: float = 0.0
    end_s: float = math.inf


class _Feature(msgspec.Struct, frozen=True):
    names: list[str] | dict[str, list[str]] | None = None
    dtype: str = ""


class _Info(msgspec.Struct, frozen=True):
    codebase_version: str
    robot_type: str | None = None
    features: dict[str, _Feature] = {}


def is_lerobot_dataset(source: Path) -> bool:
    """Return True if `source` is the folder of a LeRobotDataset."""
    return (source / INFO).is_file()


def read_lerobot_dataset(source: Path, units: LeRobotUnits, marker: MarkerTrack) -> Recording:
    """Read the joints of all episodes, interpolated to the marker's times; `marker.run` is the episode.

    Raises:
        RecordingError: it cannot be read, lacks joints, or the unit of its readings is not clear.
    """
    info = _info(source)
    names = _motor_names(info, source)
    missing = [servo.joint for servo in units.servos if servo.joint not in names]
    if missing:
        raise RecordingError(
            f"{STATE} has no motor {', '.join(missing)}; it has {', '.join(names)}",
            file=source / INFO,
            remedy="Correct [robot] joints of robot.toml",
        )
    state, t, episode = _rows(source, names)
    columns = [names.index(servo.joint) for servo in units.servos]
    readings = state[:, columns]
    unit = units.unit or _unit_of(readings, source)
    q = np.column_stack(
        [
            servo.angles(units.motors[servo.joint].ticks(readings[:, k], unit, servo.make))
            for k, servo in enumerate(units.servos)
        ]
    )
    joints = tuple(servo.joint for servo in units.servos)
    return joined(joints, JointTrack(t, q, episode.astype(np.int64)), marker, source)


def video_parts(source: Path, camera: str) -> list[VideoPart]:
    """Return the location of each episode in the videos of `camera`, such as `observation.images.front`.

    Raises:
        RecordingError: the dataset has no such camera, or cannot be read.
    """
    info = _info(source)
    cameras = [name for name, feature in info.features.items() if feature.dtype == "video"]
    if camera not in cameras:
        raise RecordingError(
            f"the dataset has no video {camera}", file=source / INFO, remedy=f"It has {', '.join(cameras) or 'none'}"
        )
    videos = source / "videos"
    if info.codebase_version.startswith("v2.1"):
        files = sorted(videos.glob(f"chunk-*/{camera}/episode_*.mp4"))
        parts = [VideoPart(file, int(file.stem.removeprefix("episode_"))) for file in files]
    else:
        keys = [f"videos/{camera}/{key}" for key in ("chunk_index", "file_index", "from_timestamp", "to_timestamp")]
        parts = [
            VideoPart(
                videos / camera / f"chunk-{int(chunk):03d}" / f"file-{int(number):03d}.mp4", int(episode), begin, end
            )
            for episode, chunk, number, begin, end in _table(source / "meta" / "episodes", ["episode_index", *keys])
        ]
    if not parts:
        raise RecordingError(f"there are no files of {camera}", file=videos, remedy="Download the dataset whole")
    return parts


def _table(folder: Path, columns: Sequence[str]) -> list[tuple[float, ...]]:
    """Return the rows of these columns of all Parquet files in a folder."""
    (pyarrow, _), rows = arrow_modules(folder, _WHAT), list[tuple[float, ...]]()
    for file in sorted(folder.rglob("*.parquet")):
        try:
            with bounded_memory(FileLimits.memory_bytes), opened(file, MAX_BYTES) as stream:
                table = pyarrow.parquet.ParquetFile(stream).read(columns=list(columns))
            numbers = np.column_stack([table.column(name).to_numpy().astype(np.float64) for name in columns])
            if not np.isfinite(numbers).all():
                raise ValueError("a number is missing or not finite")
        except (pyarrow.ArrowException, KeyError, ValueError, TypeError, OSError) as error:
            raise RecordingError(f"is no list of episodes: {error}", file=file) from error
        rows += [tuple(row) for row in numbers.tolist()]
    return rows


def _info(source: Path) -> _Info:
    file = source / INFO
    try:
        info = msgspec.json.decode(read_at_most(file), type=_Info)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, OSError) as error:
        raise RecordingError(f"is no description of a LeRobotDataset: {error}", file=file) from error
    if not info.codebase_version.startswith(("v2.1", "v3.")):
        raise RecordingError(
            f"the dataset has the layout {info.codebase_version}; v2.1 and v3.0 are read",
            file=file,
            remedy="Convert it with LeRobot",
        )
    if info.robot_type is not None and not info.robot_type.endswith(_NEW):
        raise RecordingError(
            f"it was recorded on {info.robot_type!r} by LeRobot before version 0.3, which counted angles otherwise",
            file=file,
            remedy="Record it again; the old calibration does not contain the zero",
        )
    return info


def _motor_names(info: _Info, source: Path) -> list[str]:
    """Return the motors in the order of the state, without the suffix `.pos`."""
    feature = info.features.get(STATE)
    names: Any = None if feature is None else feature.names
    if isinstance(names, Mapping):
        names = [name for group in names.values() for name in group]
    if not names:
        raise RecordingError(f"the dataset does not say which motors {STATE} has", file=source / INFO)
    return [name.removesuffix(".pos") for name in names]


def _rows(source: Path, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states (n, k), times (n,) [s] and episodes (n,) of all files, in their order."""
    pyarrow, _ = arrow_modules(source, _WHAT)
    files = sorted((source / "data").rglob("*.parquet"))
    if not files:
        raise RecordingError("the dataset has no data/**/*.parquet", file=source, remedy="Download it whole")
    states, times, episodes = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    left = most = ColumnLimits.max_numbers // (len(names) + len(_COLUMNS) - 1)
    for file in files:
        try:
            with bounded_memory(FileLimits.memory_bytes), opened(file, MAX_BYTES) as stream:
                parquet = pyarrow.parquet.ParquetFile(stream)
                left -= parquet.metadata.num_rows
                if left < 0:
                    raise ValueError(f"there are more than {most:,} rows with the files before it")
                table = parquet.read(columns=list(_COLUMNS))
            flat = pyarrow.concat_arrays(table.column(STATE).chunks).flatten().to_numpy(zero_copy_only=False)
            states.append(flat.astype(np.float64).reshape(len(table), len(names)))
            times.append(table.column("timestamp").to_numpy().astype(np.float64))
            numbers = table.column("episode_index").to_numpy().astype(np.float64)
            finite = np.isfinite(np.column_stack([states[-1], times[-1], numbers])).all(axis=1)
            if not finite.all():
                raise ValueError(f"row {int(np.argmin(finite)) + 1} has a number that is missing or not finite")
            episodes.append(numbers.astype(np.int64))
        except (pyarrow.ArrowException, AttributeError, KeyError, ValueError, TypeError, OSError) as error:
            message = (getattr(error, "strerror", None) or str(error)).strip().split("\n")[0].rstrip(".")
            raise RecordingError(f"is no data of a LeRobotDataset: {message}", file=file) from error
    if left == most:
        raise RecordingError("the dataset has no rows", file=source, remedy="Record an episode")
    return np.concatenate(states), np.concatenate(times), np.concatenate(episodes)


def _unit_of(readings: np.ndarray, source: Path) -> Unit:
    if np.abs(readings).max() > 100.0:
        return "degrees"
    raise RecordingError(
        "its readings may be degrees or -100…100, and the dataset does not say which",
        file=source,
        remedy=f"Give --lerobot-unit, one of {', '.join(BODY_UNITS)}: `use_degrees` of the robot's configuration",
    )
