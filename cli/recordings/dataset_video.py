"""Track the marker in the videos of a LeRobotDataset, or in the images of a ROS bag."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from bodyschema.daemon.config import Config
from bodyschema.interfaces.errors import RecordingError, SourceEnded
from bodyschema.interfaces.protocols import MarkerSource
from bodyschema.interfaces.records import MarkerFix, MarkerMiss
from bodyschema.recordings.lerobot_dataset import VideoPart, video_parts
from bodyschema.recordings.ros_bag import read_images
from bodyschema.recordings.tracks import MarkerTrack

# Times of frames are multiples of their interval, and rounded in the list of episodes.
_EARLY_S = 1e-3


def markers_in_video(config: Config, source: Path, camera: str) -> MarkerTrack:
    """Return the marker's positions in a dataset's videos of `camera`, timed from the start of each episode.

    Raises:
        RecordingError: there is no such video, or the marker is never seen.
        ConfigError: nothing says how the camera sees, or a video cannot be decoded.
    """
    fixes = list[tuple[float, int, MarkerFix]]()
    parts = sorted(video_parts(source, camera), key=lambda part: (part.file, part.begin_s))
    for file, of_file in groupby(parts, key=lambda part: part.file):
        fixes += _fixes(config, file, list(of_file))
    return _track(fixes, source, camera)


def markers_in_images(config: Config, bag: Path, topic: str) -> MarkerTrack:
    """Return the marker's positions in a bag's compressed images.

    Raises:
        RecordingError: there is no such topic, or the marker is never seen.
        ConfigError: nothing says how the camera sees, or the images cannot be decoded.
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
    with tracked_video(config, file) as video:
        for seen in _seen(video):
            part = next((part for part in reversed(parts) if part.begin_s - _EARLY_S <= seen.t), None)
            if part is not None and seen.t < part.end_s - _EARLY_S and isinstance(seen, MarkerFix):
                found.append((seen.t - part.begin_s, part.episode, seen))
    return found
