"""A recording for the Rerun viewer. Needs the extra `rerun`.

| entity | archetype | content |
| --- | --- | --- |
| /measurement_frame | ViewCoordinates | x right, y down, z forward |
| /measurement_frame/marker | Points3D | the marker of the row, and with an orientation its Transform3D |
| /measurement_frame/path | LineStrips3D | all positions, a strip for each segment; on no timeline |
| /joints/<name> | Scalars | the joint's angle [rad], or m where it slides |

Timelines: `pair`, counted from 1, and `time` [s], which is `Recording.play_times`.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.extras import install_command
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording

from .store.store import Devices

FRAME, JOINTS = "measurement_frame", "joints"
RADIUS_M = 0.004


def write_rerun(recording: Recording, file: Path, _devices: Sequence[Devices] = ()) -> None:
    """Write `recording` to `file`.

    Raises:
        RecordingError: the extra `rerun` is not installed, or the file cannot be written.
    """
    rr = _rerun(file)
    try:
        file.touch()  # this error names the file; rerun's does not
        stream = rr.RecordingStream("bodyschema")
        stream.save(file)
    except RuntimeError as error:
        raise RecordingError(f"cannot be written: {error}", file=file) from error
    stream.log(FRAME, rr.ViewCoordinates.RDF, static=True)
    stream.log(f"{FRAME}/path", rr.LineStrips3D(runs(recording)), static=True)
    rows = [
        rr.TimeColumn("pair", sequence=np.arange(1, len(recording) + 1)),
        rr.TimeColumn("time", duration=recording.play_times),
    ]
    _send_markers(rr, stream, recording, rows)
    for name, angles in zip(recording.joints, recording.q.T, strict=True):
        entity = rr.new_entity_path([JOINTS, name])
        stream.send_columns(entity, indexes=rows, columns=rr.Scalars.columns(scalars=np.ascontiguousarray(angles)))
    stream.flush()
    stream.disconnect()


def _send_markers(rr: Any, stream: Any, recording: Recording, rows: list[Any]) -> None:
    entity, n = f"{FRAME}/marker", len(recording)
    if recording.orientation is None:
        points = rr.Points3D.columns(positions=recording.x, radii=np.full(n, RADIUS_M))
    else:
        points = rr.Points3D.columns(positions=np.zeros((n, 3)), radii=np.full(n, RADIUS_M))
        turned = rr.Transform3D.columns(translation=recording.x, quaternion=recording.orientation)
        stream.send_columns(entity, indexes=rows, columns=turned)
    stream.send_columns(entity, indexes=rows, columns=points)


def runs(recording: Recording) -> list[FloatArray]:
    """Return the positions of each segment, (m, 3) [m]; of all rows if there are no segments."""
    if recording.segment is None:
        return [recording.x]
    return np.split(recording.x, np.flatnonzero(np.diff(recording.segment)) + 1)


def _rerun(file: Path) -> Any:
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise RecordingError(
            "Rerun files need the extra `rerun`",
            file=file,
            remedy=f"Install it with `{install_command('rerun')}`, or use CSV",
        ) from error
