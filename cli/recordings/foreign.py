"""Recordings of other programs: ROS bags and LeRobotDatasets, besides CSV, Parquet and stores."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from bodyschema.cli.commands.options import SourceOptions
from bodyschema.cli.hardware.lerobot_robot import joint_servos
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.servos import require_servos
from bodyschema.interfaces.errors import RecordingError, SourceEnded
from bodyschema.interfaces.protocols import MarkerSource
from bodyschema.interfaces.records import MarkerFix, MarkerMiss
from bodyschema.recordings import files as recordings
from bodyschema.recordings.lerobot_dataset import (
    INFO,
    LeRobotUnits,
    VideoPart,
    is_lerobot_dataset,
    read_lerobot_dataset,
    video_parts,
)
from bodyschema.recordings.recording import Recording, read_table
from bodyschema.recordings.ros_bag import METADATA, BagTopics, is_bag, read_bag, read_images
from bodyschema.recordings.tracks import MarkerTrack
from bodyschema.robot.lerobot import Unit, read_calibration, where_calibrations_are


def markers_in_video(config: Config, source: Path, camera: str) -> MarkerTrack:
    """Return the marker's positions in a dataset's videos of `camera`, timed from the start of each episode.

    Raises:
        RecordingError: there is no such video, or the marker is never found.
        ConfigError: the camera has no calibration, or a video cannot be decoded.
    """
    fixes = list[tuple[float, int, MarkerFix]]()
    parts = sorted(video_parts(source, camera), key=lambda part: (part.file, part.begin_s))
    for file, of_file in groupby(parts, key=lambda part: part.file):
        fixes += _fixes(config, file, list(of_file))
    return _track(fixes, source, camera)


def markers_in_images(config: Config, bag: Path, topic: str) -> MarkerTrack:
    """Return the marker's positions in a bag's compressed images.

    Raises:
        RecordingError: there is no such topic, or the marker is never found.
        ConfigError: the camera has no calibration, or the images cannot be decoded.
    """
    from bodyschema.daemon.wiring.cameras import tracked_images

    with tempfile.TemporaryDirectory(prefix="bodyschema-bag-") as name:
        folder, times = Path(name), list[float]()
        for t, image in read_images(bag, topic):
            if times and t <= times[-1]:  # sent twice, or out of order
                continue
            (folder / f"{len(times):07d}.jpg").write_bytes(image)
            times.append(t)
        (folder / "times.txt").write_text("\n".join(map(repr, times)))
        if not times:
            raise RecordingError(f"{topic} has no images", file=bag, remedy="Record it")
        with tracked_images(config, folder) as images:
            fixes = [(seen.t, 0, seen) for seen in _seen(images) if isinstance(seen, MarkerFix)]
    return _track(fixes, bag, topic)


def _track(fixes: list[tuple[float, int, MarkerFix]], source: Path, camera: str) -> MarkerTrack:
    if not fixes:
        raise RecordingError(
            f"the marker is nowhere in {camera}",
            file=source,
            remedy="Correct [vision] of robot.toml; `bodyschema watch cameras` shows what the tracker sees",
        )
    return MarkerTrack(
        np.array([t for t, _, _ in fixes]),
        np.array([fix.x for _, _, fix in fixes]),
        np.array([episode for _, episode, _ in fixes], dtype=np.int64),
        np.array([fix.cov for _, _, fix in fixes]),
    )


def _seen(camera: MarkerSource) -> Iterator[MarkerFix | MarkerMiss]:
    try:
        while True:
            if (seen := camera.read(0.0)) is not None:
                yield seen
    except SourceEnded:
        return


def _fixes(config: Config, file: Path, parts: list[VideoPart]) -> list[tuple[float, int, MarkerFix]]:
    from bodyschema.daemon.wiring.cameras import tracked_video

    found = list[tuple[float, int, MarkerFix]]()
    early_s = 1e-3  # times of frames are multiples of their interval, and rounded in the list of episodes
    with tracked_video(config, file) as video:
        for seen in _seen(video):
            part = next((part for part in reversed(parts) if part.begin_s - early_s <= seen.t), None)
            if part is not None and seen.t < part.end_s - early_s and isinstance(seen, MarkerFix):
                found.append((seen.t - part.begin_s, part.episode, seen))
    return found


def seen_elsewhere(source: Path, taken: SourceOptions) -> bool:
    """Return True if the positions in `source` may not come from the cameras in robot.toml.

    This is so for a bag's topic, or a separate file. A table or store is assumed to come from one of these cameras.
    """
    foreign = is_lerobot_dataset(source) or is_bag(source)
    return foreign and (taken.markers is not None or taken.video is None)


def opened(config: Config, source: Path, taken: SourceOptions, lerobot: Path | None) -> Recording:
    """Return the recording in `source`, in any format.

    Args:
        taken: the parts of a bag or a dataset.
        lerobot: LeRobot's calibration of the arm that a dataset was recorded with.

    Raises:
        RecordingError, StoreError: it cannot be read, or the parts to read are ambiguous.
        ConfigError: another file that it needs is wrong.
    """
    marker = None if taken.markers is None else read_marker_track(taken.markers)
    joints, delay_s = config.robot.joints, 1e-3 * taken.marker_delay_ms
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
        return read_lerobot_dataset(
            source, _units(config, source, lerobot, taken.lerobot_unit), marker.earlier(delay_s)
        )
    if is_bag(source):
        if marker is None and taken.video is not None:
            marker = markers_in_images(config, source, taken.video)
        robot = config.tables.drivers.ros2
        names = {} if robot is None else robot.names
        topics = BagTopics(taken.joint_topic, taken.marker_topic, taken.marker_frame, names, delay_s)
        return read_bag(source, joints, topics, marker)
    if source.is_dir() and not source.suffix:
        raise RecordingError(
            f"a folder with neither {METADATA}, as of a ROS bag, nor {INFO}, as of a LeRobotDataset",
            file=source,
            remedy="Name a recording",
        )
    return recordings.opened(source, joints)


def read_marker_track(file: Path) -> MarkerTrack:
    """Read the marker's positions from a recording without joints: t, x, y, z and optional columns of recordings.

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


def _units(config: Config, source: Path, lerobot: Path | None, unit: Unit | None) -> LeRobotUnits:
    if lerobot is None:
        raise RecordingError(
            "a dataset does not say how its arm was calibrated",
            file=source,
            remedy=f"Give --lerobot CALIBRATION.json. {where_calibrations_are()}",
        )
    servos = {servo.joint: servo for servo in joint_servos(require_servos(config))}
    configured = [servos[joint] for joint in config.robot.joints]
    return LeRobotUnits(read_calibration(lerobot, config.robot.joints), configured, unit)
