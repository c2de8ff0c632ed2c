"""Read external files safely: regular files only, up to the largest plausible size of their kind."""

from __future__ import annotations

import errno
import io
import os
import resource
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO


class FileLimits:
    # For text written by a person or a command: over ten times the size of any URDF, log or table of ours.
    text_bytes = 2**24
    # What reading one file may take: 20 million joint states of some 200 bytes. A file of 256 kB can unpack to 8 GiB.
    memory_bytes = 2**32


_KINDS = (
    (stat.S_ISCHR, "a device, not a file"),
    (stat.S_ISBLK, "a device, not a file"),
    (stat.S_ISFIFO, "a pipe, not a file"),
    (stat.S_ISSOCK, "a socket, not a file"),
)


class UnfitFile(OSError):
    """A file that is refused: a device or a pipe, or larger than plausible for its kind."""


def check_regular(file: Path) -> None:
    """Check that a library can read `file` to its end.

    Raises:
        UnfitFile: it is a device, a pipe or a socket, which may have no end.
        OSError: it is a folder, or cannot be examined.
    """
    _require_regular(os.stat(file).st_mode)


@contextmanager
def opened(file: Path, max_bytes: int) -> Iterator[BinaryIO]:
    """Open a regular file for reading.

    Args:
        max_bytes: largest plausible size of its kind [bytes].

    Raises:
        UnfitFile: it is larger, or a device, a pipe or a socket.
        OSError: it cannot be read.
    """
    check_regular(file)  # before it is opened: opening a port or a watchdog has side effects
    with open(file, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as stream:
        state = os.fstat(stream.fileno())
        _require_regular(state.st_mode)
        if state.st_size > max_bytes:
            raise _too_large(max_bytes)
        yield stream


def read_at_most(file: Path, max_bytes: int = FileLimits.text_bytes) -> bytes:
    """Return the bytes of a regular file. Raise the errors of `opened`."""
    data = bytearray()
    with opened(file, max_bytes) as stream:
        while piece := stream.read(io.DEFAULT_BUFFER_SIZE):  # files of /proc report no size
            data += piece
            if len(data) > max_bytes:
                raise _too_large(max_bytes)
    return bytes(data)


@contextmanager
def bounded_memory(max_bytes: int) -> Iterator[None]:
    """Limit a library that unpacks a file to `max_bytes` bytes of additional memory, and to files of as many bytes.

    Beyond that, allocations fail in the whole process, with MemoryError or the library's own error. A lower existing
    limit stays. If the system does not report sizes, memory is not limited.
    """
    limits = {resource.RLIMIT_FSIZE: max_bytes}
    try:
        with open("/proc/self/statm", "rb") as stream:
            limits[resource.RLIMIT_AS] = int(stream.read().split()[0]) * resource.getpagesize() + max_bytes
    except OSError:
        pass
    with ExitStack() as undo:
        for kind, limit in limits.items():
            soft, hard = resource.getrlimit(kind)
            if limit < min((each for each in (soft, hard) if each != resource.RLIM_INFINITY), default=limit + 1):
                resource.setrlimit(kind, (limit, hard))
                undo.callback(resource.setrlimit, kind, (soft, hard))
        yield


def _require_regular(mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    for is_kind, what in _KINDS:
        if is_kind(mode):
            raise UnfitFile(errno.EINVAL, what)


def _too_large(max_bytes: int) -> UnfitFile:
    size = f"{max_bytes // 2**30} GiB" if max_bytes >= 2**30 else f"{max_bytes // 2**20} MiB"
    return UnfitFile(errno.EFBIG, f"larger than {size}")
