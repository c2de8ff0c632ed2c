"""Write files that appear complete or not at all, even if the disk fails."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from bodyschema.interfaces.errors import ConfigError, RecordingError

BACKUP = ".before"


def require_target(
    out: Path, endings: Collection[str], what: str, *, force: bool, error: type[ConfigError | RecordingError]
) -> None:
    """Raise `error` unless `what` can be written to `out`: one of the endings, in a folder, and no file in the way."""
    if out.suffix.lower() not in endings:
        raise error(f"{what} end in {', '.join(endings)}", file=out, remedy="Give another name")
    if not out.parent.is_dir():
        raise error(f"there is no folder {out.parent}", file=out, remedy="Make it first")
    if out.exists() and not force:
        raise error("the file is there already", file=out, remedy="Give another name, or --force")


@contextmanager
def raising_write_errors(
    file: Path, error: type[ConfigError | RecordingError] = ConfigError, *, what: str = "written", remedy: str = ""
) -> Iterator[None]:
    """Raise `error` with the system's reason if `file` cannot be created or written."""
    try:
        yield
    except OSError as failed:
        raise error(f"cannot be {what}: {failed.strerror or failed}", file=file, remedy=remedy) from failed


def write_atomically(contents: Mapping[Path, bytes], *, mode: int | None = None) -> None:
    """Write files, replacing existing ones: all of them once all are on the disk, otherwise none.

    Args:
        contents: contents of each file.
        mode: permissions of the files; by default those of new files.

    Raises:
        OSError: one of them cannot be written; nothing was changed.
    """
    token = secrets.token_hex(4)
    parts = {file.with_name(f".{token}.{place}.part"): file for place, file in enumerate(contents)}
    try:
        for part, file in parts.items():
            with part.open("xb") as stream:
                stream.write(contents[file])
                stream.flush()
                os.fsync(stream.fileno())
            if mode is not None:
                part.chmod(mode)
        for part, file in parts.items():
            os.replace(part, file)
    finally:
        for part in parts:
            part.unlink(missing_ok=True)


def replace_with_backup(file: Path, data: bytes, beside: Mapping[str, bytes] | None = None) -> Path:
    """Replace a file, and keep the old one beside it; return the name of the old one.

    The target of a link is replaced, not the link. Permissions stay.

    Args:
        file: the file to replace.
        data: its new contents.
        beside: contents of other files to write with it, by the suffix that they add to the name of the file.

    Raises:
        OSError: one of them cannot be written; nothing was changed.
    """
    target = link_target(file)
    backup = free_backup(target)
    others = {target.with_name(f"{target.name}{ending}"): text for ending, text in (beside or {}).items()}
    contents = {backup: target.read_bytes(), **others, target: data}
    write_atomically(contents, mode=stat.S_IMODE(target.stat().st_mode))
    return backup


def link_target(file: Path) -> Path:
    """Return the target of a link; return any other file unchanged."""
    return file.resolve() if file.is_symlink() else file


def free_backup(file: Path) -> Path:
    """Return an unused name for the old file."""
    count, name = 1, file.with_name(f"{file.name}{BACKUP}")
    while os.path.lexists(name):
        count += 1
        name = file.with_name(f"{file.name}{BACKUP}{count}")
    return name


def unused_name(file: Path, why: str) -> Path:
    """Return a free name next to `file`, such as `pairs.sqlite.damaged-1` for the first damaged one."""
    number = 1
    while os.path.lexists(name := file.with_name(f"{file.name}.{why}-{number}")):
        number += 1
    return name


def sync_folder(folder: Path) -> None:
    """Sync a folder's entries to disk. Without this, a power cut may undo a rename."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
