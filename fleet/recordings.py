"""Selection of the recordings to diagnose, each with its robot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bodyschema.cli.commands.options import robot_file
from bodyschema.interfaces.errors import RecordingError, RequestError
from bodyschema.recordings.files import STORE_ENDINGS
from bodyschema.recordings.recording import CSV, PARQUET

ENDINGS = (CSV, PARQUET, *STORE_ENDINGS)


@dataclass(frozen=True)
class Job:
    name: str  # unique name of the row and of the report's folder
    recording: Path  # its file
    robot: Path  # its robot.toml


def jobs(recordings: Sequence[Path], folder: Path | None, robot: Path | None) -> list[Job]:
    """Return the given recordings and those in a folder, each with `robot` or the robot.toml next to it.

    A recording has the name of its file; if two files have the same name, that of the folder and the file.

    Raises:
        RequestError: no recording was given.
        RecordingError: the folder does not exist, or has none.
    """
    found = [*recordings, *([] if folder is None else _in(folder))]
    files = list(dict.fromkeys(found))
    if not files:
        raise RequestError(
            f"there is nothing to diagnose. Name recordings ({', '.join(ENDINGS)}), or a folder by --from"
        )
    stems = Counter(file.stem for file in files)
    names = [file.stem if stems[file.stem] == 1 else f"{file.absolute().parent.name}_{file.stem}" for file in files]
    alike = Counter(names)
    numbered = [name if alike[name] == 1 else f"{name}_{k}" for k, name in enumerate(names, 1)]
    return [Job(name, file, robot_file(robot, file)) for name, file in zip(numbered, files, strict=True)]


def _in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise RecordingError("there is no such folder", file=folder, remedy="Give the folder with the recordings")
    found = sorted(file for file in folder.rglob("*") if file.suffix.lower() in ENDINGS and file.is_file())
    if not found:
        raise RecordingError(f"no recording is in it ({', '.join(ENDINGS)})", file=folder, remedy="Give another --from")
    return found
