"""Start Python interpreters as child processes that do not import from the current folder."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


def this_interpreter() -> str:
    """Return the path of this interpreter."""
    return os.path.abspath(sys.executable)


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs `module` with this interpreter."""
    return [this_interpreter(), "-P", "-m", module, *arguments]


def end(process: subprocess.Popen[Any], limit_s: float) -> int:
    """Terminate a process, kill it after a time limit [s], and return its exit code."""
    process.terminate()
    try:
        return process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


@contextmanager
def safe_children() -> Iterator[None]:
    """Start interpreters with `-P` even where another package builds the command, as multiprocessing does."""
    name = "PYTHONSAFEPATH"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        os.environ.pop(name) if before is None else os.environ.update({name: before})
