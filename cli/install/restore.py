"""Restore a robot from a backup, completely or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodyschema.daemon.config import ZenohConfig, state_home
from bodyschema.daemon.learner.checkpoint import CheckpointError, read_checkpoint, write_checkpoint
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import is_alive
from bodyschema.interfaces.errors import ConfigError, StoreError
from bodyschema.interfaces.whole_files import sync_folder, unused_name
from bodyschema.recordings.store import schema as store_schema
from bodyschema.recordings.store.file import NOTHING_CHANGED, explained, lock
from bodyschema.recordings.store.store import leave_out_damage
from bodyschema.robot.toml_file import convert, read_toml

from .backup import CHECKPOINT, ELSEWHERE, ROBOT, ROBOT_TOML, STORE, Backup, BackupError, description_files

# Suffixes of the files that SQLite keeps for a store that was not closed; empty: the store itself.
STORE_PARTS = ("", "-wal", "-shm")


@dataclass(frozen=True, slots=True)
class Restored:
    written: list[Path]  # the new files
    aside: list[Path]  # files that were in their places before, under their new names
    elsewhere: dict[str, Path]  # files that robot.toml names outside its folder: new path by original path
    store: str  # identity of the store from now on
    unreadable: int  # number of pairs between the oldest and the newest that are missing, because a disk corrupted them


def restore(backup: Backup, robot_file: Path, state_dir: Path | None = None, *, force: bool = False) -> Restored:
    """Restore robot.toml and its files to `robot_file`, and the state to the folder that this robot.toml names.

    The store gets a new identity, because from now on its numbers may belong to other pairs than in the original. The
    checkpoint gets the same identity; a learner elsewhere will report that pairs come from another store.

    Args:
        state_dir: folder for the state; None for the one of robot.toml, if that is in its folder.
        force: existing files may be moved aside.

    Raises:
        BackupError: something is in the way, a process runs, or a file cannot be written; nothing was changed.
        StoreError: the store is being written, or the one in the backup is not a store; nothing was changed.
    """
    robot_file = robot_file.absolute()
    tables = _tables(backup)
    described = _targets(backup, tables, robot_file)
    fresh = {target: name for name, target in described.items() if not backup.has(name, target)}
    folder = _state_dir(backup, tables, robot_file) if state_dir is None else state_dir.absolute()
    state = {folder / Path(name).name: name for name in (STORE, CHECKPOINT) if name in backup.manifest.files}
    targets = fresh | state
    _require_room(backup, targets, force=force)
    _require_at_rest(backup, tables)
    aside: list[Path] = []
    with _writable(robot_file.parent), ExitStack() as undo:
        for target in targets:
            _make_folder(target.parent, undo)
        lock_held = _locked(folder / Path(STORE).name, undo)
        with ExitStack() as scratch:
            staged = _staged(backup, targets, scratch)
            store, checkpoint = (staged.get(folder / Path(name).name) for name in (STORE, CHECKPOINT))
            identity, unreadable = _give_identity(backup, tables, store, checkpoint)
            for target in targets:
                aside += _move_aside(target, undo)
                os.replace(staged[target], target)
                undo.callback(target.unlink)
            for parent in {target.parent for target in targets}:
                sync_folder(parent)
        undo.pop_all()
        os.close(lock_held)
    elsewhere = {
        backup.manifest.files[name].origin: target
        for name, target in described.items()
        if name.startswith(f"{ROBOT}/{ELSEWHERE}/")
    }
    return Restored(list(targets), aside, elsewhere, identity, unreadable)


def _tables(backup: Backup) -> dict[str, Any]:
    """Return the tables of the backup's robot.toml."""
    with tempfile.TemporaryDirectory(prefix="bodyschema-restore-") as scratch:
        file = Path(scratch) / "robot.toml"
        backup.extract(ROBOT_TOML, file)
        try:
            return read_toml(file)[0]
        except ConfigError as error:
            raise BackupError(
                f"the robot.toml in {backup.file} cannot be read: {error.what}. {NOTHING_CHANGED}"
            ) from error


def _targets(backup: Backup, tables: Mapping[str, Any], robot_file: Path) -> dict[str, Path]:
    """Return the targets of the description's files; robot.toml may have another name here."""
    allowed = {ROBOT_TOML, *description_files(tables)}
    backed_up = backup.manifest.files.keys() - {STORE, CHECKPOINT}
    if backed_up != allowed:
        unexpected = sorted(backed_up - allowed)
        what = (
            f"has {unexpected[0]!r}, which its robot.toml does not name so"
            if unexpected
            else "lacks a file that robot.toml names"
        )
        raise BackupError(f"{backup.file} {what}. {NOTHING_CHANGED}")
    inside = {name: name.removeprefix(f"{ROBOT}/") for name in backed_up}
    return {name: robot_file if name == ROBOT_TOML else robot_file.parent / path for name, path in inside.items()}


def _state_dir(backup: Backup, tables: Mapping[str, Any], robot_file: Path) -> Path:
    daemon = tables.get("daemon")
    configured = daemon.get("state_dir") if isinstance(daemon, dict) else None
    if not isinstance(configured, str):
        return state_home() / backup.manifest.robot
    home = robot_file.parent.resolve()
    folder = (home / configured).resolve()
    seen = folder.is_relative_to(home) and not any(part.startswith(".") for part in folder.relative_to(home).parts)
    if not (seen or backup.has(ROBOT_TOML, robot_file)):
        where = "in a hidden folder" if folder.is_relative_to(home) else "outside of its folder"
        raise BackupError(
            f"the robot.toml in {backup.file} keeps samples and checkpoint {where}. {NOTHING_CHANGED}. "
            f"Give --state-dir {str(folder)!r} to put them there, or another folder"
        )
    return folder


def _require_room(backup: Backup, targets: Iterable[Path], *, force: bool) -> None:
    existing = [str(target) for target in targets if target.exists()]
    if existing and not force:
        raise BackupError(
            f"{', '.join(existing)}: there already, and not what {backup.file} has. {NOTHING_CHANGED}. Give --force, "
            "which moves what is there aside, or another --robot or --state-dir"
        )


def _require_at_rest(backup: Backup, tables: Mapping[str, Any]) -> None:
    zenoh, robot = tables.get("zenoh"), backup.manifest.robot
    addresses = {key: zenoh[key] for key in ("sampler", "learner") if key in zenoh} if isinstance(zenoh, dict) else {}
    try:
        endpoints = convert(addresses, ZenohConfig, file=backup.file, text="", prefix=("zenoh",))
    except ConfigError as error:
        raise BackupError(f"the robot.toml in {error}. {NOTHING_CHANGED}") from error
    for process in ("sampler", "learner"):
        if is_alive(getattr(endpoints, process), Keys(robot).alive(process)):
            raise BackupError(
                f"the {process} of {robot} runs. {NOTHING_CHANGED}. Stop it first: "
                f"`systemctl stop bodyschema-{process}@{robot}`, or Ctrl-C where it was started"
            )


@contextmanager
def _writable(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        what = error.strerror or error
        raise BackupError(f"{error.filename or folder} cannot be written: {what}. {NOTHING_CHANGED}") from error


def _make_folder(folder: Path, undo: ExitStack) -> None:
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    for each in reversed(missing):
        each.mkdir()
        undo.callback(each.rmdir)


def _locked(store: Path, undo: ExitStack) -> int:
    file = store.with_name(store.name + ".lock")
    if not file.exists():
        undo.callback(file.unlink, missing_ok=True)
    descriptor = lock(store)
    undo.callback(os.close, descriptor)
    return descriptor


def _staged(backup: Backup, targets: Mapping[Path, str], scratch: ExitStack) -> dict[Path, Path]:
    """Write the files into new folders next to their targets."""
    staged: dict[Path, Path] = {}
    for parent in dict.fromkeys(target.parent for target in targets):
        here = {target: name for target, name in targets.items() if target.parent == parent}
        needed, free = sum(backup.manifest.files[name].size for name in here.values()), shutil.disk_usage(parent).free
        if needed > free:
            raise BackupError(
                f"{parent} has {free / 1e6:.0f} MB free, and {needed / 1e6:.0f} MB are needed. {NOTHING_CHANGED}"
            )
        place = Path(tempfile.mkdtemp(prefix=".restore-", dir=parent))
        scratch.callback(shutil.rmtree, place, ignore_errors=True)
        for number, (target, name) in enumerate(here.items()):
            staged[target] = place / str(number)
            backup.extract(name, staged[target])
    return staged


def _give_identity(
    backup: Backup, tables: Mapping[str, Any], store: Path | None, checkpoint: Path | None
) -> tuple[str, int]:
    """Give a new identity to the staged store, and the same to the staged checkpoint if it is usable.

    Returns:
        The identity, and the number of unreadable pairs in the store.
    """
    assert store is not None
    robot = tables.get("robot")
    joints = robot.get("joints") if isinstance(robot, dict) else None
    try:
        audit = leave_out_damage(store, joints if isinstance(joints, list) else ())
        identity = str(uuid.uuid4())
        with explained(store), closing(store_schema.connect(store)) as connection:
            contents = store_schema.meta(connection)
            before = contents["store"]
            with store_schema.transaction(connection):
                store_schema.write_meta(connection, {**contents, "store": identity, "restored_from": before})
            connection.execute("PRAGMA journal_mode = DELETE")  # everything in one file
    except (StoreError, ValueError) as error:
        what = str(error).replace(str(store), STORE)
        raise BackupError(f"the store in {backup.file} cannot be put back: {what}") from error
    try:
        state = None if checkpoint is None else read_checkpoint(checkpoint, robot=backup.manifest.robot)
    except CheckpointError:
        state = None  # the learner will report the problem, and learn from the pairs
    if checkpoint is not None and state is not None and state.header.counters.store == before:
        state.header.counters.store = identity
        write_checkpoint(checkpoint, state, robot=backup.manifest.robot, utc=backup.manifest.written_utc)
    return identity, audit.damage.count


def _move_aside(target: Path, undo: ExitStack) -> list[Path]:
    """Rename existing files so that they are kept; return the new names."""
    parts = [part for part in STORE_PARTS if os.path.lexists(target.with_name(target.name + part))]
    aside = unused_name(target, "before-restore")
    moved = {target.with_name(target.name + part): aside.with_name(aside.name + part) for part in parts}
    for there, name in moved.items():
        there.rename(name)
        undo.callback(name.rename, there)
    return list(moved.values())
