"""A recording as MCAP with JSON messages, for Foxglove and the tools of rosbag. Needs the extra `export`.

| topic | schema | content |
| --- | --- | --- |
| /pair | bodyschema.Row | every column of the row under its own name, exactly |
| /marker | foxglove.PoseInFrame | the marker, for the 3-D panel; unrotated if no orientation was recorded |

Metadata `bodyschema` has the joints and the number of rows. Metadata `devices/1`, `devices/500` … describe as JSON the
device of each joint from that pair on: servo, firmware, homing offset and so on.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.parquet_file import imported
from bodyschema.recordings.recording import Recording

from .store.store import Devices

FRAME_ID = "measurement_frame"
UNTURNED = (0.0, 0.0, 0.0, 1.0)
LATEST_S = 9e9  # limit of nanoseconds in 64 bits

_POINT = {"type": "object", "properties": {name: {"type": "number"} for name in ("x", "y", "z")}}
_QUATERNION = {"type": "object", "properties": {name: {"type": "number"} for name in ("x", "y", "z", "w")}}
_TIME = {"type": "object", "title": "time", "properties": {name: {"type": "integer"} for name in ("sec", "nsec")}}
_POSE_IN_FRAME = {
    "title": "foxglove.PoseInFrame",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "pose": {
            "type": "object",
            "title": "foxglove.Pose",
            "properties": {"position": _POINT, "orientation": _QUATERNION},
        },
    },
}


def write_mcap(recording: Recording, file: Path, devices: Sequence[Devices] = ()) -> None:
    """Write `recording` to `file`; message times are `Recording.play_times`, shifted to begin at 0 if negative.

    Args:
        devices: the encoders of its joints, for the metadata.

    Raises:
        RecordingError: the extra `export` is not installed, or a time does not fit nanoseconds.
        OSError: the file cannot be written.
    """
    writer_type = imported("mcap.writer", "export", "MCAP, unlike CSV,", file).Writer
    times_ns = _nanoseconds(recording, file)
    with file.open("wb") as stream:
        writer = writer_type(stream)
        writer.start(profile="", library="bodyschema")
        writer.add_metadata("bodyschema", {"joints": _json(recording.joints).decode(), "rows": str(len(recording))})
        for part in devices:
            joints = {str(device["joint"]): _json(device).decode() for device in part.record}
            about = {"from_seq": str(part.from_seq), "utc": part.utc}
            writer.add_metadata(f"devices/{part.from_seq}", about | joints)
        _write_rows(writer, recording, times_ns)
        _write_markers(writer, recording, times_ns)
        writer.finish()


def _write_rows(writer: Any, recording: Recording, times_ns: list[int]) -> None:
    table = recording.to_table()
    schema = {
        "title": "bodyschema.Row",
        "type": "object",
        "properties": {name: {"type": "integer" if name == "segment" else "number"} for name in table.names},
    }
    channel = _channel(writer, "/pair", "bodyschema.Row", schema)
    for number, (time_ns, row) in enumerate(zip(times_ns, table.values.tolist(), strict=True)):
        message: dict[str, float] = dict(zip(table.names, row, strict=True))
        if recording.segment is not None:
            message["segment"] = int(recording.segment[number])
        writer.add_message(channel, time_ns, _json(message), time_ns, number)


def _write_markers(writer: Any, recording: Recording, times_ns: list[int]) -> None:
    channel = _channel(writer, "/marker", "foxglove.PoseInFrame", _POSE_IN_FRAME)
    turns = [UNTURNED] * len(recording) if recording.orientation is None else recording.orientation.tolist()
    for number, (time_ns, x, turn) in enumerate(zip(times_ns, recording.x.tolist(), turns, strict=True)):
        sec, nsec = divmod(time_ns, 1_000_000_000)
        message = {
            "timestamp": {"sec": sec, "nsec": nsec},
            "frame_id": FRAME_ID,
            "pose": {"position": _named("xyz", x), "orientation": _named("xyzw", turn)},
        }
        writer.add_message(channel, time_ns, _json(message), time_ns, number)


def _channel(writer: Any, topic: str, name: str, schema: dict[str, Any]) -> int:
    schema_id = writer.register_schema(name=name, encoding="jsonschema", data=_json(schema))
    return writer.register_channel(topic=topic, message_encoding="json", schema_id=schema_id)


def _nanoseconds(recording: Recording, file: Path) -> list[int]:
    t: FloatArray = recording.play_times
    shifted = t - min(float(t[0]), 0.0)
    if shifted[-1] > LATEST_S:
        raise RecordingError(
            f"MCAP cannot store the time {shifted[-1]:g} s in nanoseconds", file=file, remedy="Give times in seconds"
        )
    return [int(ns) for ns in np.round(shifted * 1e9)]


def _named(names: str, values: Any) -> dict[str, float]:
    return dict(zip(names, values, strict=True))


def _json(message: object) -> bytes:
    return msgspec.json.encode(message)
