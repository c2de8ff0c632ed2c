"""Back up a robot (its pairs, learnt state and description) into one file, and read such files.

The file is a ZIP archive. `manifest.json` lists the contents with a checksum of each file; `state/` has the store and
the checkpoint, `robot/` has robot.toml and the files that it names.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Any

import msgspec

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.checkpoint import checkpoint_bytes
from bodyschema.interfaces.errors import BodyschemaError, StoreError
from bodyschema.recordings.store import schema as store_schema
from bodyschema.recordings.store.file import explained
from bodyschema.recordings.store.store import Audit, PairReader, leave_out_damage, require_store
from bodyschema.robot.description import Name
from bodyschema.robot.limited import check_regular
from bodyschema.robot.toml_file import read_toml

SCHEMA = 1
MANIFEST = "manifest.json"
STATE, ROBOT = "state", "robot"
STORE, CHECKPOINT, ROBOT_TOML = f"{STATE}/pairs.sqlite", f"{STATE}/learner.ckpt", f"{ROBOT}/robot.toml"
# Prefix for files outside robot.toml's folder; they are not restored into other folders.
ELSEWHERE = "elsewhere"
# Permitted file endings, by the robot.toml key that names the file.
NAMED_FILES = {
    ("robot", "urdf"): (".urdf", ".xml"),
    ("vision", "cameras", "calibration"): (".toml",),
    ("unexplained", "model"): (".kbmap",),
}
CHUNK, CHECKSUM_BYTES = 2**20, 32


class BackupError(BodyschemaError):
    """A backup cannot be written, read or restored."""


class Entry(msgspec.Struct, frozen=True):
    """A file in a backup: its size in bytes, its BLAKE2b checksum, and its original location."""

    size: int
    blake2b: str
    origin: str


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    robot: Name
    written_utc: str
    version: str
    store: str  # identity of the pair store
    pairs: int  # number of pairs, up to the sequence number `last_seq`
    last_seq: int
    files: dict[str, Entry]  # by name in the archive
    unreadable: int = 0  # number of pairs between the oldest and the newest that could not be read and are missing
    schema: int = SCHEMA


def write_backup(config: Config, file: Path, *, utc: str, version: str, replace: bool = False) -> Manifest:
    """Write a backup of a robot into `file`; works while it samples and learns.

    The checkpoint is read before the store, so it never contains a pair that the store lacks.

    Args:
        replace: an existing file may be replaced, once the new one is complete.

    Raises:
        BackupError: the file exists already, or cannot be written.
        StoreError: there is no store, or it is damaged.
    """
    if file.exists() and not replace:
        raise BackupError(f"{file} is there already. Give another name, or --force")
    folder = file.absolute().parent
    if not folder.is_dir():
        raise BackupError(f"there is no folder {folder}. Make it, or give another name")
    with tempfile.TemporaryDirectory(dir=folder, prefix=".backup-") as scratch, _explained(file):
        contents = _description(config)
        if config.checkpoint_file.exists():
            held = Path(scratch) / "learner.ckpt"
            held.write_bytes(checkpoint_bytes(config.checkpoint_file))
            contents[CHECKPOINT] = held
        contents[STORE] = Path(scratch) / "pairs.sqlite"
        found = copy_store(config.store_file, contents[STORE], config.robot.joints)
        with PairReader(contents[STORE]) as pairs:
            store = pairs.identity
        origins = {CHECKPOINT: config.checkpoint_file, STORE: config.store_file}
        manifest = Manifest(
            robot=config.robot.name,
            written_utc=utc,
            version=version,
            store=store,
            pairs=found.pairs,
            last_seq=found.newest,
            unreadable=found.damage.count,
            files={name: _entry(path, origins.get(name, path)) for name, path in contents.items()},
        )
        whole = Path(scratch) / "backup"
        _write_archive(whole, manifest, contents)
        os.replace(whole, file)
    return manifest


def copy_store(store: Path, copy: Path, joints: Sequence[str]) -> Audit:
    """Copy a snapshot of the store into one file, without unreadable rows; works while a sampler writes it.

    Args:
        joints: joint names for a store that lost its own.

    Raises:
        StoreError: there is no store, nothing in it can be read, or the disk is full.
    """
    require_store(store)
    with (
        explained(store),
        closing(store_schema.connect(store, readonly=True)) as source,
        closing(sqlite3.connect(copy, isolation_level=None)) as target,
    ):
        store_schema.check_kind(source, store)
        source.backup(target)
        target.execute("PRAGMA journal_mode = DELETE")
    try:
        return leave_out_damage(copy, joints)
    except StoreError as error:
        raise StoreError(str(error).replace(str(copy), str(store))) from error


class Backup:
    """A backup that was opened and verified. Use as a context manager."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._archive: zipfile.ZipFile | None = None
        self._manifest: Manifest | None = None

    def __enter__(self) -> Backup:
        try:
            with self._explained():
                check_regular(self.file)
                self._archive = zipfile.ZipFile(self.file)
                self._manifest = self._checked(self._archive)
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self._close()

    @property
    def manifest(self) -> Manifest:
        if self._manifest is None:
            raise BackupError(f"{self.file} is not open; use it in a with statement")
        return self._manifest

    def has(self, name: str, file: Path) -> bool:
        """Return True if `file` equals, byte by byte, the backup's file of this name."""
        entry = self.manifest.files[name]
        return file.exists() and _entry(file, file).blake2b == entry.blake2b

    def extract(self, name: str, target: Path) -> None:
        """Write one of the backup's files to the new file `target`; on return it is complete and synced to disk.

        Raises:
            BackupError: the archive has changed since it was opened.
            OSError: `target` cannot be written.
        """
        entry = self.manifest.files[name]
        with target.open("wb") as stream:
            with self._explained():
                source = self._open.open(name)
            with source:
                if self._copied(source, entry.size, stream.write) != entry.blake2b:
                    raise BackupError(f"{name} in {self.file} is damaged: its checksum does not match")
            stream.flush()
            os.fsync(stream.fileno())

    @property
    def _open(self) -> zipfile.ZipFile:
        if self._archive is None:
            raise BackupError(f"{self.file} is not open; use it in a with statement")
        return self._archive

    def _checked(self, archive: zipfile.ZipFile) -> Manifest:
        """Return the manifest after checking that exactly the files it lists are there."""
        infos = archive.infolist()
        names = {info.filename for info in infos}
        sizes = {info.filename: info.file_size for info in infos}
        if sizes.pop(MANIFEST, CHUNK + 1) > CHUNK:
            raise BackupError(f"{self.file} is no backup of bodyschema: it has no {MANIFEST}")
        if len({name.casefold() for name in names}) < len(infos):
            raise BackupError(f"{self.file} has two files of the same name")
        if any(info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for info in infos):
            raise BackupError(f"{self.file} is packed in another way than a backup")
        try:
            manifest = msgspec.json.decode(archive.read(MANIFEST), type=Manifest)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise BackupError(f"the {MANIFEST} of {self.file} cannot be understood: {error}") from error
        if manifest.schema != SCHEMA:
            raise BackupError(
                f"{self.file} was written by a newer bodyschema (schema {manifest.schema}, this one knows {SCHEMA}). "
                "Install the newer bodyschema"
            )
        if {STORE, ROBOT_TOML} - manifest.files.keys() or sizes.keys() != manifest.files.keys():
            raise BackupError(f"{self.file} does not hold the files that its {MANIFEST} says")
        texts = (manifest.written_utc, manifest.version, *(entry.origin for entry in manifest.files.values()))
        if not all(text.isprintable() for text in texts):
            raise BackupError(f"the {MANIFEST} of {self.file} has characters that cannot be shown")
        for name, entry in manifest.files.items():
            with archive.open(name) as stream:
                if sizes[name] != entry.size or self._copied(stream, entry.size) != entry.blake2b:
                    raise BackupError(f"{name} in {self.file} is damaged: its checksum does not match")
        return manifest

    def _copied(self, source: IO[bytes], size: int, write: Callable[[bytes], object] = len) -> str:
        """Pass at most one byte more than `size` to `write`: an archive can unpack to more than fits on the disk.

        Returns:
            Checksum of these bytes.
        """
        digest, left = hashlib.blake2b(digest_size=CHECKSUM_BYTES), size + 1
        while left > 0:
            with self._explained():
                part = source.read(min(CHUNK, left))
            if not part:
                break
            digest.update(part)
            write(part)
            left -= len(part)
        return digest.hexdigest()

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Convert zipfile's exceptions about an invalid or incomplete archive into BackupErrors."""
        try:
            yield
        except FileNotFoundError as error:
            raise BackupError(f"there is no file {self.file}") from error
        except (
            OSError,
            EOFError,
            RuntimeError,
            ValueError,
            LookupError,
            struct.error,
            zlib.error,
            zipfile.BadZipFile,
        ) as error:
            raise BackupError(f"{self.file} is no backup, or is damaged: {error}") from error

    def _close(self) -> None:
        if self._archive is not None:
            self._archive.close()
            self._archive = None


def description_files(tables: Mapping[str, Any]) -> dict[str, str]:
    """Return the files that a robot.toml with these tables names, by their names in an archive."""
    named: dict[str, str] = {}
    for keys, endings in NAMED_FILES.items():
        value: object = tables
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        if isinstance(value, str):
            named[f"{ROBOT}/{_inside(value, endings)}"] = value
    return named


def _description(config: Config) -> dict[str, Path]:
    """Return robot.toml and the files that it names, by their names in the archive."""
    home, (tables, _) = config.file.absolute().parent, read_toml(config.file)
    return {ROBOT_TOML: config.file} | {name: home / file for name, file in description_files(tables).items()}


def _inside(name: str, endings: tuple[str, ...]) -> str:
    """Return a file's archive name: relative to robot.toml if it can be restored there, otherwise under `ELSEWHERE`.

    A file can be restored if it lies in robot.toml's folder, is not hidden (`.git/hooks/…`), and has an ending usual
    for its kind, so that no program would execute it.
    """
    path = PurePosixPath(os.path.normpath(name))
    plain = not path.is_absolute() and not any(part.startswith(".") for part in path.parts)
    if plain and path.suffix.lower() in endings and str(path).isprintable() and str(path) != Path(ROBOT_TOML).name:
        return str(path)
    stem = "".join(char if char.isalnum() or char in "-_" else "_" for char in path.stem)
    return f"{ELSEWHERE}/{stem or 'file'}{endings[0]}"


def _write_archive(file: Path, manifest: Manifest, contents: Mapping[str, Path]) -> None:
    # The file may contain passwords from robot.toml.
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w+b") as stream:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(MANIFEST, msgspec.json.format(msgspec.json.encode(manifest)))
            for name, path in contents.items():
                archive.write(path, name)
        stream.flush()
        os.fsync(stream.fileno())


def _entry(file: Path, origin: Path) -> Entry:
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=CHECKSUM_BYTES))
        return Entry(stream.tell(), digest.hexdigest(), str(origin.absolute()))


@contextmanager
def _explained(file: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BackupError(f"{file} cannot be written: {error.strerror or error}. Nothing was changed") from error
