"""Recordings as other programs made them: ROS bags and LeRobotDatasets, beside CSV, Parquet and stores."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodyschema.cli.hardware.lerobot_robot import joint_servos
from bodyschema.cli.recordings.dataset_video import markers_in_images, markers_in_video
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.servos import require_servos
from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings import files as recordings
from bodyschema.recordings.lerobot_dataset import INFO, LeRobotUnits, is_lerobot_dataset, read_lerobot_dataset
from bodyschema.recordings.recording import Recording, read_table
from bodyschema.recordings.ros_bag import METADATA, BagTopics, is_bag, read_bag
from bodyschema.recordings.tracks import MarkerTrack
from bodyschema.robot.lerobot import Unit, read_calibration, where_calibrations_are


@dataclass(frozen=True)
class Taken:
    """Selection from a bag or a dataset whose contents are ambiguous.

    Attributes:
        joint_topic, marker_topic, marker_frame: of a bag; see `BagTopics`.
        video: the camera in whose videos the marker is tracked; of a bag, the topic of its images.
        markers: a file with the marker's positions: t, x, y, z, and in `segment` the episode.
        lerobot: LeRobot's calibration of the arm that a dataset was recorded with.
        lerobot_unit: of a dataset's readings.
        delay_s: delay of the time stamps of the marker's positions [s].
    """

    joint_topic: str | None = None
    marker_topic: str | None = None
    marker_frame: str | None = None
    markers: Path | None = None
    video: str | None = None
    lerobot: Path | None = None
    lerobot_unit: Unit | None = None
    delay_s: float = 0.0


def opened(config: Config, source: Path, taken: Taken) -> Recording:
    """Return the recording in `source`, whatever its format.

    Raises:
        RecordingError, StoreError: it cannot be read, or what to take of it is not clear.
        ConfigError: a file that it needs besides is wrong.
    """
    marker = None if taken.markers is None else read_marker_track(taken.markers)
    joints = config.robot.joints
    if is_lerobot_dataset(source):
        if marker is None and taken.video is not None:
            marker = markers_in_video(config, source, taken.video)
        if marker is None:
            raise RecordingError(
                "a LeRobotDataset has no marker positions",
                file=source,
                remedy="Name its camera with --video observation.images.NAME, or give the marker's positions with "
                "--markers FILE.csv: t, x, y, z, and the episode as segment",
            )
        return read_lerobot_dataset(source, _units(config, source, taken), marker.earlier(taken.delay_s))
    if is_bag(source):
        if marker is None and taken.video is not None:
            marker = markers_in_images(config, source, taken.video)
        robot = config.tables.drivers.ros2
        names = {} if robot is None else robot.names
        topics = BagTopics(taken.joint_topic, taken.marker_topic, taken.marker_frame, names, taken.delay_s)
        return read_bag(source, joints, topics, marker)
    if source.is_dir() and not source.suffix:
        raise RecordingError(
            f"a folder with neither {METADATA}, as of a ROS bag, nor {INFO}, as of a LeRobotDataset",
            file=source,
            remedy="Name a recording",
        )
    return recordings.opened(source, joints)


def read_marker_track(file: Path) -> MarkerTrack:
    """Read the marker's positions from a recording without joints: t, x, y, z and what else a recording may have.

    Raises:
        RecordingError: it cannot be read, or has no times.
    """
    table = read_table(file, ())
    if not table.has(("t",)):
        raise RecordingError("there is no column t", file=file, remedy="Add the times of the positions [s]")
    found = Recording.from_table(table, (), file)
    t = np.asarray(found.t)
    run = np.zeros(len(t), dtype=np.int64) if found.segment is None else found.segment
    return MarkerTrack(t, found.x, run, found.cov, found.orientation)


def _units(config: Config, source: Path, taken: Taken) -> LeRobotUnits:
    if taken.lerobot is None:
        raise RecordingError(
            "a dataset does not say how its arm was calibrated",
            file=source,
            remedy=f"Give --lerobot CALIBRATION.json. {where_calibrations_are()}",
        )
    servos = {servo.joint: servo for servo in joint_servos(require_servos(config))}
    wanted = [servos[joint] for joint in config.robot.joints]
    return LeRobotUnits(read_calibration(taken.lerobot, config.robot.joints), wanted, taken.lerobot_unit)
