"""Files of a machine's configuration that are written, shown and removed together."""

from __future__ import annotations

import os
import shutil
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

from bodyschema.interfaces.errors import ConfigError

ROOT = Path("/")
Command = Sequence[str]


def run_quietly(command: Command) -> None:
    """Run the command; on a machine without it, do nothing."""
    if shutil.which(command[0]) is not None:
        subprocess.run(command, capture_output=True, check=False, timeout=10)


class MachineFiles(ABC):
    """Files below the root of a machine's file system.

    Args:
        root: that root; an image's, or this machine's.
        run: runs a command; only if `root` is this machine's.
    """

    kind: ClassVar[str]
    """As `bodyschema install` calls them."""
    reload: Sequence[Command]
    """Makes the system read the files again."""
    is_used: str
    """What the user does next."""
    before_removal: Sequence[str] = ()
    """What happens before the files are removed."""
    stays: ClassVar[str] = ""
    """What is not removed."""

    def __init__(self, root: Path = ROOT, run: Callable[[Command], None] = run_quietly) -> None:
        self.root, self._run = root, run

    @abstractmethod
    def installed(self) -> list[Path]:
        """Return the files that `uninstall` would remove."""

    def install(self, texts: dict[Path, str]) -> None:
        """Write files with their contents, and let the system read them. ConfigError: one cannot be written."""
        for file, text in texts.items():
            with writing(file, f"install {self.kind}"):
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text, encoding="utf-8")
        self._call(self.reload)

    def uninstall(self) -> None:
        """Remove the files, and the folders `NAME.d` that become empty. ConfigError: one cannot be removed."""
        for file in self.installed():
            with writing(file, f"install {self.kind} --uninstall"):
                file.unlink()
                if file.parent.suffix == ".d" and not any(file.parent.iterdir()):
                    file.parent.rmdir()
        self._call(self.reload)

    def _call(self, commands: Sequence[Command]) -> None:
        for command in commands if self.root == ROOT else ():
            self._run(command)


@contextmanager
def writing(file: Path, command: str) -> Iterator[None]:
    """Convert an OSError about `file` to a ConfigError; `command` is that of `bodyschema` for the remedy."""
    try:
        yield
    except OSError as error:
        remedy = f'Type: sudo "$(command -v bodyschema)" {command} --yes'
        if os.geteuid() == 0:
            remedy = "Look at the file system of that folder"
        raise ConfigError(f"cannot be changed: {error.strerror}", file=file, remedy=remedy) from error


def missing(texts: dict[Path, str]) -> dict[Path, str]:
    """Return those files that do not exist with these contents."""
    return {file: text for file, text in texts.items() if not file.exists() or file.read_text("utf-8") != text}
