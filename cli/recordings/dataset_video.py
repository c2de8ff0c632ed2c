"""Track the marker in the videos of a LeRobotDataset."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

import numpy as np

from bodyschema.daemon.config import Config
from bodyschema.interfaces.errors import RecordingError, SourceEnded
from bodyschema.interfaces.records import MarkerFix
from bodyschema.recordings.lerobot_dataset import VideoPart, video_parts
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
    if not fixes:
        raise RecordingError(
            f"the marker is nowhere in {camera}",
            file=source,
            remedy="Correct [vision] of robot.toml; `bodyschema watch cameras` shows what the tracker sees",
        )
    covariances = np.array([fix.cov for _, _, fix in fixes])
    return MarkerTrack(
        np.array([t for t, _, _ in fixes]),
        np.array([fix.x for _, _, fix in fixes]),
        np.array([episode for _, episode, _ in fixes], dtype=np.int64),
        covariances,
    )


def _fixes(config: Config, file: Path, parts: list[VideoPart]) -> list[tuple[float, int, MarkerFix]]:
    from bodyschema.daemon.wiring.cameras import tracked_video

    found = list[tuple[float, int, MarkerFix]]()
    try:
        with tracked_video(config, file) as video:
            while True:
                seen = video.read(0.0)
                if seen is None:
                    continue
                part = next((part for part in reversed(parts) if part.begin_s - _EARLY_S <= seen.t), None)
                if part is not None and seen.t < part.end_s - _EARLY_S and isinstance(seen, MarkerFix):
                    found.append((seen.t - part.begin_s, part.episode, seen))
    except SourceEnded:
        return found
