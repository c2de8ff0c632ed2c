"""Store the learner's state on disk in one file, replaced atomically: a kill leaves either the old or the new file.

The previous checkpoint is kept next to it, in case the disk corrupts the newest one.

Layout, all little-endian:

    magic     8 bytes   b"BSCKPT\\r\\n"
    version   uint32    3
    length    uint32    bytes of the header
    header    MessagePack: `_Header`
    arrays    float64, in the header's order
    checksum  16 bytes  BLAKE2b of everything before
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import logging
import math
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.whole_files import sync_folder, unused_name
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.state import LearningHeader, LearningState, StateError
from bodyschema.recordings.files import StoredPairs
from bodyschema.robot.limited import read_at_most
from kbmaps import KBMapsError

MAGIC = b"BSCKPT\r\n"
VERSION = 3
_PREFIX = struct.Struct("<8sII")
_CHECKSUM_BYTES = 16
# Upper bound: with the exact map of 2187 nodes and the state before a change, a checkpoint has 200 MB.
MAX_BYTES = 2**29


class CheckpointError(BodyschemaError):
    """A checkpoint cannot be written or read."""


class _ArrayEntry(msgspec.Struct, frozen=True):
    name: str
    shape: tuple[Annotated[int, msgspec.Meta(ge=0)], ...]


class _Header(msgspec.Struct, frozen=True):
    robot: str
    written_utc: str
    learning: LearningHeader
    arrays: list[_ArrayEntry]


def write_checkpoint(file: Path, state: LearningState, *, robot: str, utc: str) -> None:
    """Replace the checkpoint `file` by `state`; the old one is kept as the previous checkpoint.

    Raises:
        CheckpointError: the disk is full or read-only, or the state is unusable; the old checkpoint is still there.
    """
    invalid_array = state.invalid_array()
    if invalid_array is not None:
        raise CheckpointError(f"the checkpoint {file} was not written: {invalid_array} is not finite or too large")
    data = _encode(state, robot, utc)
    temporary = file.with_name(file.name + ".tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        _write_through(temporary, data)
        _keep_previous(file)
        os.replace(temporary, file)
        sync_folder(file.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise CheckpointError(_unwritable(file, error)) from error


def read_checkpoint(file: Path, *, robot: str) -> LearningState | None:
    """Return the state in `file`; None if there is no such file.

    Raises:
        CheckpointError: the file cannot be read, is damaged, or belongs to another robot.
    """
    if not os.path.lexists(file):
        return None
    header, payload = _decode(file, checkpoint_bytes(file))
    if header.robot != robot:
        raise CheckpointError(f"the checkpoint {file} belongs to the robot {header.robot!r}, this one is {robot!r}")
    arrays: dict[str, FloatArray] = {}
    try:
        for entry in header.arrays:
            size = 8 * math.prod(entry.shape)
            arrays[entry.name] = np.frombuffer(payload[:size], dtype="<f8").astype(np.float64).reshape(entry.shape)
            payload = payload[size:]
    except ValueError as error:  # more dimensions than numpy has
        raise CheckpointError(f"the checkpoint {file} has an array that cannot be: {error}") from error
    return LearningState(header.learning, arrays)


def checkpoint_bytes(file: Path) -> bytes:
    """Return the contents of the file.

    Raises:
        CheckpointError: the file cannot be read, is larger than a checkpoint can be, or is a device.
    """
    try:
        return read_at_most(file, MAX_BYTES)
    except OSError as error:
        raise CheckpointError(f"cannot read the checkpoint {file}: {error.strerror}") from error


def generations(file: Path) -> tuple[Path, Path]:
    """Return the paths at which a checkpoint is searched for: `file`, and its predecessor."""
    return file, file.with_name(file.name + ".previous")


def set_aside(file: Path) -> Path:
    """Rename an unusable checkpoint so that it is kept but no longer in the way; return the new path."""
    aside = unused_name(file, "unusable")
    try:
        file.rename(aside)
    except OSError as error:
        raise CheckpointError(f"cannot move the unusable checkpoint {file} aside: {error.strerror}") from error
    return aside


def _encode(state: LearningState, robot: str, utc: str) -> bytes:
    entries = [_ArrayEntry(name, array.shape) for name, array in state.arrays.items()]
    header = msgspec.msgpack.encode(_Header(robot, utc, state.header, entries))
    arrays = [np.ascontiguousarray(array, dtype="<f8").tobytes() for array in state.arrays.values()]
    body = b"".join([_PREFIX.pack(MAGIC, VERSION, len(header)), header, *arrays])
    return body + _checksum(body)


def _decode(file: Path, data: bytes) -> tuple[_Header, memoryview]:
    if len(data) < _PREFIX.size + _CHECKSUM_BYTES or not data.startswith(MAGIC):
        raise CheckpointError(f"{file} is not a checkpoint")
    _, version, length = _PREFIX.unpack_from(data)
    if version != VERSION:
        raise CheckpointError(f"the checkpoint {file} has the version {version}; this bodyschema reads {VERSION}")
    body, checksum = data[:-_CHECKSUM_BYTES], data[-_CHECKSUM_BYTES:]
    if _checksum(body) != checksum:
        raise CheckpointError(f"the checkpoint {file} is damaged: its checksum does not match")
    end = _PREFIX.size + length
    try:
        header = msgspec.msgpack.decode(body[_PREFIX.size : end], type=_Header)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise CheckpointError(f"the checkpoint {file} cannot be understood: {error}") from error
    payload = memoryview(body)[end:]
    if len(payload) != sum(8 * math.prod(entry.shape) for entry in header.arrays):
        raise CheckpointError(f"the checkpoint {file} does not hold the arrays that its header announces")
    return header, payload


def _keep_previous(file: Path) -> None:
    """Link the current checkpoint under a second name before it is replaced, so that one is always complete."""
    if not file.exists():
        return
    previous = generations(file)[1]
    previous.unlink(missing_ok=True)
    try:
        os.link(file, previous)
    except OSError:  # a file system without hard links
        os.replace(file, previous)


def _write_through(file: Path, data: bytes) -> None:
    with file.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _checksum(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_CHECKSUM_BYTES).digest()


def _unwritable(file: Path, error: OSError) -> str:
    if error.errno == errno.ENOSPC:
        return f"the checkpoint {file} could not be written: the disk is full. Free some space; learning continues"
    if isinstance(error, (FileExistsError, NotADirectoryError)):
        return (
            f"the checkpoint {file} could not be written: {file.parent} is not a folder. Learning continues; "
            "give a folder as state_dir in the table [daemon] of robot.toml, or with --state-dir"
        )
    return (
        f"the checkpoint {file} could not be written: {error.strerror}. Learning continues; "
        "give a --state-dir that can be written"
    )


log = logging.getLogger(__name__)

# Exceptions of a checkpoint whose checksum is right but whose contents do not fit.
INVALID_CONTENT_ERRORS = (ArithmeticError, LookupError, TypeError, ValueError)


def resume_from_checkpoint(
    new: Callable[[], OnlineLearner], checkpoint: Path, robot: str
) -> tuple[OnlineLearner, str | None]:
    """Restore the learner from the newest usable checkpoint.

    Args:
        new: creates a learner without data.
        checkpoint: the newest one; if unusable, it is kept next to it under another name.

    Returns:
        The learner, and a message about the fault, or None.

    Raises:
        CheckpointError: an unusable checkpoint cannot be moved aside.
    """
    problems: list[str] = []
    for file in generations(checkpoint):
        learning = new()
        try:
            state = read_checkpoint(file, robot=robot)
            if state is None:
                continue
            learning.restore(state)
        except (CheckpointError, StateError, KBMapsError, *INVALID_CONTENT_ERRORS) as error:
            unfit = isinstance(error, INVALID_CONTENT_ERRORS)
            why = f"the checkpoint's parts do not fit: {error!r}" if unfit else str(error)
            problems.append(f"{why}. It was kept as {set_aside(file)}")
            continue
        pairs = learning.counters.pairs
        log.info("went on from %s with %d samples", file, pairs)
        return learning, _log_problems(
            [*problems, f"the learner went on from {file} with {pairs} samples"]
        ) if problems else None
    return new(), _log_problems(
        [*problems, "the learner learns again from the sampler's history"]
    ) if problems else None


def _log_problems(problems: list[str]) -> str:
    text = "; ".join(problems)
    log.error("%s", text)
    return text


def first_pair(pairs: StoredPairs, checkpoint: Path, robot: str) -> int:
    """Return the row, from 1, of the first pair with the present tool.

    Returns 1 if no learner of these pairs has left a checkpoint. Pairs from before a `reset_to_prior` do not count as
    pairs with the present tool.
    """
    try:
        state = read_checkpoint(checkpoint, robot=robot)
    except CheckpointError:  # the learner reports it; the recording can be calibrated without
        return 1
    if state is None or state.header.counters.store != pairs.store:
        return 1
    counters = state.header.counters
    number = counters.last_seq - counters.since_change + 1
    return sum(each < number for each in pairs.numbers) + 1
