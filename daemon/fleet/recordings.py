"""Which recordings are diagnosed, and of which robot each is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bodyschema.daemon.commands.options import robot_file
from bodyschema.daemon.recordings import STORE_ENDINGS
from bodyschema.interfaces.errors import RecordingError, RequestError
from bodyschema.interfaces.recording import CSV, PARQUET

ENDINGS = (CSV, PARQUET, *STORE_ENDINGS)


@dataclass(frozen=True)
class Job:
    """One recording to diagnose.

    Attributes:
        name: of the row and of the report's folder; no two are alike.
        robot: its robot.toml.
    """

    name: str
    recording: Path
    robot: Path


def jobs(recordings: Sequence[Path], folder: Path | None, robot: Path | None) -> list[Job]:
    """The recordings that were named and those in a folder, each with `robot` or the robot.toml beside it.

    A recording is called as its file; where two files are called alike, as the folder and the file.

    Raises:
        RequestError: none was asked for.
        RecordingError: the folder is none, or has none.
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
