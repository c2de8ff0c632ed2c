"""Python interpreters as child processes: none imports from the current folder, whose files are a user's own."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs `module` with this interpreter."""
    return [os.path.abspath(sys.executable), "-P", "-m", module, *arguments]


@contextmanager
def safe_children() -> Iterator[None]:
    """Start interpreters with `-P` where other packages write the command, as multiprocessing does (`python -c`)."""
    name = "PYTHONSAFEPATH"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        os.environ.pop(name) if before is None else os.environ.update({name: before})
