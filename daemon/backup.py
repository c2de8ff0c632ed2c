"""A robot in one file: its pairs, what was learnt of them, its description; and back again.

A ZIP archive. `manifest.json` says what is in it, with a checksum of each file; `state/` has the store and the
checkpoint, `robot/` robot.toml and the files that it names.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

import msgspec

from interfaces.errors import BodyschemaError
from interfaces.robot import Name

from . import store_schema
from .config import Config
from .store import PairReader
from .store_file import explained

SCHEMA = 1
MANIFEST = "manifest.json"
STATE, ROBOT = "state", "robot"
STORE, CHECKPOINT, ROBOT_TOML = f"{STATE}/pairs.sqlite", f"{STATE}/learner.ckpt", f"{ROBOT}/robot.toml"
# Of files that lie outside robot.toml's folder, which is not restored into other folders.
ELSEWHERE = "elsewhere"
CHUNK = 2**20


class BackupError(BodyschemaError):
    """A backup cannot be written, read or restored."""


class Entry(msgspec.Struct, frozen=True):
    """A file in a backup: its size in bytes and its BLAKE2b, and where it was."""

    size: int
    blake2b: str
    origin: str


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """What a backup is of.

    Attributes:
        store: identity of the pair store.
        pairs: how many pairs there are, up to the number `last_seq`.
        files: by name in the archive.
    """

    robot: Name
    written_utc: str
    version: str
    store: str
    pairs: int
    last_seq: int
    files: dict[str, Entry]
    schema: int = SCHEMA


def write_backup(config: Config, file: Path, *, utc: str, version: str, replace: bool = False) -> Manifest:
    """Write a backup of a robot into `file`, also while it samples and learns.

    The checkpoint is read before the store is: it never knows a pair that the store does not.

    Args:
        replace: a file that is there may be replaced, once the new one is whole.

    Raises:
        BackupError: it is there already, or cannot be written.
        StoreError: there is no store, or it is damaged.
    """
    if file.exists() and not replace:
        raise BackupError(f"{file} is there already. Give another name, or --force")
    with tempfile.TemporaryDirectory(dir=_folder_of(file), prefix=".backup-") as scratch, _explained(file):
        contents = _description(config)
        if config.checkpoint_file.exists():
            held = Path(scratch) / "learner.ckpt"
            held.write_bytes(config.checkpoint_file.read_bytes())
            contents[CHECKPOINT] = held
        contents[STORE] = copy_store(config.store_file, Path(scratch) / "pairs.sqlite")
        with PairReader(contents[STORE]) as pairs:
            store, first, last = pairs.identity, pairs.first_seq(), pairs.last_seq()
        origins = {CHECKPOINT: config.checkpoint_file, STORE: config.store_file}
        manifest = Manifest(
            robot=config.robot.name,
            written_utc=utc,
            version=version,
            store=store,
            pairs=last - first + 1,
            last_seq=last,
            files={name: _entry(path, origins.get(name, path)) for name, path in contents.items()},
        )
        whole = Path(scratch) / "backup"
        _write_archive(whole, manifest, contents)
        os.replace(whole, file)
    return manifest


def copy_store(store: Path, copy: Path) -> Path:
    """A copy of the store as it is at one moment, in one file, sound; also while a sampler writes it.

    Raises:
        StoreError: there is no store, it is damaged, or the disk is full.
    """
    with (
        PairReader(store),
        explained(store),
        closing(store_schema.connect(store, readonly=True)) as source,
        closing(sqlite3.connect(copy, isolation_level=None)) as target,
    ):
        source.backup(target)
        target.execute("PRAGMA journal_mode = DELETE")
        store_schema.check_health(target, store)
    return copy


class Backup:
    """A backup that was opened and found whole. Use as a context manager."""

    def __init__(self, file: Path) -> None:
        """Nothing is opened yet."""
        self.file = file
        self._archive: zipfile.ZipFile | None = None
        self._manifest: Manifest | None = None

    def __enter__(self) -> Backup:
        try:
            self._archive = zipfile.ZipFile(self.file)
            self._manifest = self._checked(self._archive)
        except FileNotFoundError as error:
            raise BackupError(f"there is no file {self.file}") from error
        except (OSError, zipfile.BadZipFile, EOFError, NotImplementedError) as error:
            self._close()
            raise BackupError(f"{self.file} is no backup, or is damaged: {error}") from error
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self._close()

    @property
    def manifest(self) -> Manifest:
        """What it is of."""
        if self._manifest is None:
            raise BackupError(f"{self.file} is not open; use it in a with statement")
        return self._manifest

    def has(self, name: str, file: Path) -> bool:
        """Whether `file` is, byte by byte, what the backup has under this name."""
        entry = self.manifest.files[name]
        return file.exists() and _entry(file, file).blake2b == entry.blake2b

    def text(self, name: str) -> str:
        """One of its files as text."""
        return self._open.read(name).decode()

    def extract(self, name: str, target: Path) -> None:
        """Write one of its files to `target`, which is whole and on the disk afterwards."""
        with self._open.open(name) as source, target.open("wb") as stream:
            while part := source.read(CHUNK):
                stream.write(part)
            stream.flush()
            os.fsync(stream.fileno())

    @property
    def _open(self) -> zipfile.ZipFile:
        if self._archive is None:
            raise BackupError(f"{self.file} is not open; use it in a with statement")
        return self._archive

    def _checked(self, archive: zipfile.ZipFile) -> Manifest:
        """The manifest, when every file is there as it says, and no other."""
        sizes = {info.filename: info.file_size for info in archive.infolist()}
        if sizes.pop(MANIFEST, CHUNK + 1) > CHUNK:
            raise BackupError(f"{self.file} is no backup of bodyschema: it has no {MANIFEST}")
        try:
            manifest = msgspec.json.decode(archive.read(MANIFEST), type=Manifest)
        except msgspec.DecodeError as error:
            raise BackupError(f"the {MANIFEST} of {self.file} cannot be understood: {error}") from error
        if manifest.schema != SCHEMA:
            raise BackupError(
                f"{self.file} was written by a newer bodyschema (schema {manifest.schema}, this one knows {SCHEMA}). "
                "Install the newer bodyschema"
            )
        if {STORE, ROBOT_TOML} - manifest.files.keys() or sizes.keys() != manifest.files.keys():
            raise BackupError(f"{self.file} does not hold the files that its {MANIFEST} says")
        for name, entry in manifest.files.items():
            _require_inside(name)
            with archive.open(name) as stream:
                if sizes[name] != entry.size or _checksum(stream, entry.size) != entry.blake2b:
                    raise BackupError(f"{name} in {self.file} is damaged: its checksum does not match")
        return manifest

    def _close(self) -> None:
        if self._archive is not None:
            self._archive.close()
            self._archive = None


def _description(config: Config) -> dict[str, Path]:
    """robot.toml and the files that it names, by their names in the archive."""
    home, cameras = config.file.absolute().parent, config.tables.vision.cameras
    named = [config.robot.robot.urdf, None if cameras is None else cameras.calibration, _model_of(config)]
    contents = {ROBOT_TOML: config.file}
    for name in named:
        if name is not None:
            contents[f"{ROBOT}/{_inside(name)}"] = home / name
    return contents


def _model_of(config: Config) -> str | None:
    """The file of what is unexplained, as robot.toml names it."""
    unexplained = config.tables.unexplained
    return None if unexplained is None else unexplained["model"]


def _inside(name: str) -> str:
    """A file's name as robot.toml has it, where that is in robot.toml's folder; else one that is."""
    path = PurePosixPath(os.path.normpath(name))
    if path.is_absolute() or ".." in path.parts:
        return f"{ELSEWHERE}/{path.name}"
    return str(path)


def _require_inside(name: str) -> None:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or str(path) != name or path.parts[0] not in (STATE, ROBOT):
        raise BackupError(f"{name!r} is no name for a file in a backup: it would be written elsewhere")


def _write_archive(file: Path, manifest: Manifest, contents: Mapping[str, Path]) -> None:
    # It may hold passwords of robot.toml.
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w+b") as stream:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(MANIFEST, msgspec.json.format(msgspec.json.encode(manifest)))
            for name, path in contents.items():
                archive.write(path, name)
        stream.flush()
        os.fsync(stream.fileno())


def _entry(file: Path, origin: Path) -> Entry:
    size = file.stat().st_size
    with file.open("rb") as stream:
        return Entry(size, _checksum(stream, size), str(origin.absolute()))


def _checksum(stream: IO[bytes], size: int) -> str:
    """Of at most one byte more than `size`: an archive can unpack to more than the disk holds."""
    digest, left = hashlib.blake2b(digest_size=32), size + 1
    while left > 0 and (part := stream.read(min(CHUNK, left))):
        digest.update(part)
        left -= len(part)
    return digest.hexdigest()


def _folder_of(file: Path) -> Path:
    folder = file.absolute().parent
    if not folder.is_dir():
        raise BackupError(f"there is no folder {folder}. Make it, or give another name")
    return folder


@contextmanager
def _explained(file: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BackupError(f"{file} cannot be written: {error.strerror or error}. Nothing was changed") from error
