"""Convert pairs to recordings, and write recordings to files atomically."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import Pair
from bodyschema.interfaces.whole_files import require_target
from bodyschema.recordings.recording import CSV, PARQUET, Recording, joints_in

from .mcap_export import write_mcap
from .rerun_export import Scene, write_rerun
from .store.store import Devices, PairReader

log = logging.getLogger(__name__)

MCAP, RERUN, URDF = ".mcap", ".rrd", ".urdf"
STORE_ENDINGS = (".sqlite", ".sqlite3", ".db")

_WRITERS: dict[str, Callable[[Recording, Path, Sequence[Devices], Scene | None], None]] = {
    CSV: lambda recording, file, *_: recording.write_csv(file),
    PARQUET: lambda recording, file, *_: recording.write_parquet(file),
    MCAP: lambda recording, file, devices, _: write_mcap(recording, file, devices),
    RERUN: lambda recording, file, _, scene: write_rerun(recording, file, scene),
}


def from_pairs(pairs: Sequence[Pair], joints: tuple[str, ...], file: Path | None = None) -> Recording:
    """Return the recording of one or more `pairs`, with pixel centres and orientations if every pair has them.

    Args:
        file: their origin, for messages.
    """
    centres = [pair.centres_px for pair in pairs]
    turns = [pair.R for pair in pairs if pair.R is not None]
    if 0 < len(turns) < len(pairs):
        log.warning("%d of %d samples have no orientation, so it is left out", len(pairs) - len(turns), len(pairs))
    return Recording(
        joints=joints,
        q=np.array([pair.q for pair in pairs]),
        x=np.array([pair.x for pair in pairs]),
        t=np.array([pair.t for pair in pairs]),
        cov=np.array([pair.cov for pair in pairs]),
        segment=np.array([pair.segment for pair in pairs]),
        centres_px=None if None in centres else np.array(centres),
        orientation=np.array(turns) if len(turns) == len(pairs) else None,
        file=file,
    )


@dataclass(frozen=True)
class StoredPairs:
    store: str  # its identity
    recording: Recording  # all pairs in it that can be read; rows are counted from 1
    numbers: Sequence[int]  # sequence number of each row, ascending


def from_store(file: Path) -> Recording:
    return stored_pairs(file).recording


def stored_pairs(file: Path) -> StoredPairs:
    """Return all readable pairs of a store, which a sampler may be writing meanwhile. Log the unreadable ones.

    Raises:
        StoreError: it cannot be read.
        RecordingError: it has no pairs.
    """
    with PairReader(file) as reader:
        pairs, damage = reader.read(), reader.audit().damage
        if damage.count:
            log.warning("%s", damage.sentence(file))
        if not pairs:
            raise RecordingError("the store has no samples", file=file, remedy="Move the arm in front of the camera")
        return StoredPairs(pairs[0].store, from_pairs(pairs, reader.joints, file), [pair.seq for pair in pairs])


def devices_of(store: Path) -> list[Devices]:
    """Return the encoders that a store's joints were read with; raise StoreError if it cannot be read."""
    with PairReader(store) as reader:
        return reader.devices()


def opened(source: Path, joints: tuple[str, ...] | None = None) -> Recording:
    """Return the recording, or the pairs of the store, in `source`.

    Args:
        joints: the robot's joints; None for those of `source`.

    Raises:
        StoreError, RecordingError: it cannot be read, or has other joints.
    """
    if source.suffix.lower() in STORE_ENDINGS:
        recording = from_store(source)
        return recording if joints is None else of_robot(recording, joints, source)
    return Recording.read(source, joints_in(source) if joints is None else joints)


def of_robot(recording: Recording, joints: tuple[str, ...], file: Path) -> Recording:
    """Return the recording; raise RecordingError if its joints are not these in this order."""
    if recording.joints != joints:
        raise RecordingError(
            f"the samples are of other joints: {', '.join(recording.joints)}",
            file=file,
            remedy=f"Give the robot.toml that they were taken with; this one has {', '.join(joints)}",
        )
    return recording


def between(recording: Recording, first: int, last: int | None, file: Path) -> Recording:
    """Return the rows `first` to `last`, counted from 1; raise RecordingError if there are none."""
    numbers = np.arange(1, len(recording) + 1)
    chosen = (numbers >= first) & (numbers <= (last or len(recording)))
    if not chosen.any():
        upto = "" if last is None else f" to number {last}"
        raise RecordingError(
            f"there are no samples from number {first} on{upto}; the last one is {len(recording)}",
            file=file,
            remedy="Move the arm in front of the camera, or give another --first",
        )
    return recording.rows(chosen)


def check_target(out: Path, *, force: bool) -> None:
    """Raise RecordingError unless a recording can be written to `out`: known ending, no file in the way."""
    if out.suffix.lower() == URDF:
        raise RecordingError(
            "a URDF is of a robot, not of samples", file=out, remedy="`bodyschema calibrate` learns one"
        )
    require_target(out, _WRITERS, "recordings", force=force, error=RecordingError)


def write(recording: Recording, out: Path, devices: Sequence[Devices] = (), scene: Scene | None = None) -> None:
    """Write `recording` in the format of the ending of `out`. The file appears once it is complete.

    Args:
        devices: the encoders of the joints; only MCAP stores them.
        scene: the robot and its cameras; only Rerun's files show it.

    Raises:
        RecordingError: it cannot be written, or an extra that the format needs is not installed.
    """
    part = out.with_name(f".{out.stem}.part{out.suffix}")
    try:
        _WRITERS[out.suffix.lower()](recording, part, devices, scene)
        os.replace(part, out)
    except RecordingError as error:
        raise RecordingError(error.what, file=out, remedy=error.remedy) from error
    except OSError as error:
        raise RecordingError(f"cannot be written: {error.strerror or error}", file=out) from error
    finally:
        part.unlink(missing_ok=True)
