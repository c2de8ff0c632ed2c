"""A robot put back from a backup."""

from __future__ import annotations

import os
import tomllib
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from . import store_schema
from .backup import CHECKPOINT, ELSEWHERE, ROBOT, ROBOT_TOML, STORE, Backup, BackupError
from .bus import is_alive
from .checkpoint import CheckpointError, read_checkpoint, write_checkpoint
from .config import ZenohConfig, state_home
from .keys import Keys
from .store import PairReader
from .store_file import explained, lock

STAGED = ".restored"
# What SQLite keeps beside a store that was not closed; empty: the store itself.
STORE_PARTS = ("", "-wal", "-shm")


@dataclass(frozen=True, slots=True)
class Restored:
    """What was put where.

    Attributes:
        written: the files that are new.
        aside: what was in their places before, under its new names.
        elsewhere: of files that robot.toml names outside its folder: where they are now, by where they were.
        store: identity of the store from now on.
    """

    written: list[Path]
    aside: list[Path]
    elsewhere: dict[str, Path]
    store: str


def restore(backup: Backup, robot_file: Path, state_dir: Path | None = None, *, force: bool = False) -> Restored:
    """Put robot.toml and what it names where `robot_file` says, and the state where that robot.toml says.

    The store gets a new identity: from here on its numbers may mean other pairs than in the store that was backed up.
    The checkpoint is given the same one; a learner elsewhere will say that pairs come from another store.

    Args:
        backup: opened.
        state_dir: where the state goes; None: where robot.toml says.
        force: what is in the way may be moved aside.

    Raises:
        BackupError: something is in the way, a process runs, or a file cannot be written; nothing was changed.
        StoreError: the store is being written; nothing was changed.
    """
    robot_file = robot_file.absolute()
    described = _targets(backup, robot_file)
    fresh = {target: name for name, target in described.items() if not backup.has(name, target)}
    tables = tomllib.loads(backup.text(ROBOT_TOML))
    folder = _state_dir(tables, robot_file, backup.manifest.robot) if state_dir is None else state_dir.absolute()
    state = {folder / Path(name).name: name for name in (STORE, CHECKPOINT) if name in backup.manifest.files}
    _require_room(backup, [*fresh, *state], force=force)
    _require_at_rest(tables, backup.manifest.robot)
    with _writable(), _staged(backup, fresh | state) as staged:
        identity = _give_identity(backup, folder)
        descriptor = lock(folder / Path(STORE).name)
        try:
            aside = [moved for target in staged for moved in _move_aside(target)]
            for target in staged:
                os.replace(_staging(target), target)
        finally:
            os.close(descriptor)
    elsewhere = {
        backup.manifest.files[name].origin: target
        for name, target in described.items()
        if name.startswith(f"{ROBOT}/{ELSEWHERE}/")
    }
    return Restored(staged, aside, elsewhere, identity)


def _targets(backup: Backup, robot_file: Path) -> dict[str, Path]:
    """Where the description's files belong; robot.toml may be called otherwise here."""
    inside = {name: name.removeprefix(f"{ROBOT}/") for name in backup.manifest.files if name.startswith(f"{ROBOT}/")}
    return {name: robot_file if name == ROBOT_TOML else robot_file.parent / path for name, path in inside.items()}


def _state_dir(tables: Mapping[str, Any], robot_file: Path, robot: str) -> Path:
    given = tables.get("daemon", {}).get("state_dir")
    return state_home() / robot if given is None else (robot_file.parent / given).resolve()


def _require_room(backup: Backup, targets: Iterable[Path], *, force: bool) -> None:
    there = [str(target) for target in targets if target.exists()]
    if there and not force:
        raise BackupError(
            f"{', '.join(there)}: there already, and not what {backup.file} has. Nothing was changed. Give --force, "
            "which moves what is there aside, or another --robot or --state-dir"
        )


def _require_at_rest(tables: Mapping[str, Any], robot: str) -> None:
    endpoints = msgspec.convert(
        {key: value for key, value in tables.get("zenoh", {}).items() if key in ("sampler", "learner")}, ZenohConfig
    )
    for process in ("sampler", "learner"):
        if is_alive(getattr(endpoints, process), Keys(robot).alive(process)):
            raise BackupError(
                f"the {process} of {robot} runs. Nothing was changed. Stop it first: "
                f"`systemctl stop bodyschema-{process}@{robot}`, or Ctrl-C where it was started"
            )


@contextmanager
def _writable() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BackupError(f"{error.filename} cannot be written: {error.strerror}. Nothing was changed") from error


@contextmanager
def _staged(backup: Backup, targets: Mapping[Path, str]) -> Iterator[list[Path]]:
    """The files under other names beside their places; what is left under them is removed."""
    try:
        for target, name in targets.items():
            target.parent.mkdir(parents=True, exist_ok=True)
            backup.extract(name, _staging(target))
        yield list(targets)
    finally:
        for target in targets:
            _staging(target).unlink(missing_ok=True)


def _give_identity(backup: Backup, folder: Path) -> str:
    """A new identity for the staged store, and the same for the staged checkpoint where it is of use."""
    store, checkpoint = (_staging(folder / Path(name).name) for name in (STORE, CHECKPOINT))
    with PairReader(store) as pairs:
        before = pairs.identity
    identity = str(uuid.uuid4())
    with explained(store), closing(store_schema.connect(store)) as connection:
        store_schema.check_health(connection, store)
        with store_schema.transaction(connection):
            connection.execute("UPDATE meta SET value = ? WHERE key = 'store'", (identity,))
            connection.execute("INSERT OR REPLACE INTO meta VALUES ('restored_from', ?)", (before,))
    try:
        state = read_checkpoint(checkpoint, robot=backup.manifest.robot)
    except CheckpointError:
        return identity  # the learner will say what is wrong with it, and learn from the pairs
    if state is not None and state.header.counters.store == before:
        state.header.counters.store = identity
        write_checkpoint(checkpoint, state, robot=backup.manifest.robot, utc=backup.manifest.written_utc)
    return identity


def _move_aside(target: Path) -> list[Path]:
    """Rename what is there, so that it is kept; its new names."""
    parts = [part for part in STORE_PARTS if target.with_name(target.name + part).exists()]
    number = 1
    while (aside := target.with_name(f"{target.name}.before-restore-{number}")).exists():
        number += 1
    for part in parts:
        target.with_name(target.name + part).rename(aside.with_name(aside.name + part))
    return [aside.with_name(aside.name + part) for part in parts]


def _staging(target: Path) -> Path:
    return target.with_name(target.name + STAGED)
