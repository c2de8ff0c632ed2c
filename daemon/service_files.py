"""The files of a robot's service on a machine: written, shown and removed as one."""

from __future__ import annotations

import os
import pwd
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from interfaces.errors import ConfigError

from .config import Config
from .udev import ROOT, run_quietly
from .units import FOLDER, OWN, PROCESSES, Installed, of_robot, template

Run = Callable[[Sequence[str]], None]
OLDEST_SYSTEMD = 252  # what is not asked is taken for this one


@dataclass(frozen=True, slots=True)
class ServiceFiles:
    """The units of one robot.

    Attributes:
        processes: sampler, learner or both.
        root: of the machine's file system.
        run: runs a command; only where `root` is this machine's.
    """

    robot: str
    processes: Sequence[str] = PROCESSES
    root: Path = ROOT
    run: Run = run_quietly

    @property
    def units(self) -> list[str]:
        """Names of this robot's units."""
        return [f"bodyschema-{process}@{self.robot}.service" for process in self.processes]

    def texts(self, config: Config, user: str, installed: Installed) -> dict[Path, str]:
        """What is to be in which file."""
        return {
            file: text
            for process in self.processes
            for file, text in (
                (self._template(process), template(process, installed)),
                (self._own(process), of_robot(process, config, user, installed)),
            )
        }

    def changes(self, texts: dict[Path, str]) -> dict[Path, str]:
        """Those that are not there as they should be."""
        return {file: text for file, text in texts.items() if not file.exists() or file.read_text("utf-8") != text}

    def install(self, texts: dict[Path, str]) -> None:
        """Write the files, and let systemd read them.

        Raises:
            ConfigError: one cannot be written.
        """
        for file, text in texts.items():
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text, encoding="utf-8")
            except OSError as error:
                raise self._refused(file, error, "") from error
        self._systemctl("daemon-reload")

    def uninstall(self) -> list[Path]:
        """Stop and remove this robot's units, and the templates with the last robot; what was removed.

        Raises:
            ConfigError: a file cannot be removed.
        """
        there = self.installed()
        if there:
            self._systemctl("disable", "--now", *self.units)
        for file in there:
            try:
                file.unlink()
                if file.name == OWN:
                    file.parent.rmdir()
            except OSError as error:
                raise self._refused(file, error, " --uninstall") from error
        if there:
            self._systemctl("daemon-reload")
        return there

    def installed(self) -> list[Path]:
        """What `uninstall` would remove."""
        found: list[Path] = []
        for process in self.processes:
            own, shared = self._own(process), self._template(process)
            others = [file for file in (self.root / FOLDER).glob(f"bodyschema-{process}@*.service.d/*") if file != own]
            found += [file for file in (own, *([] if others else [shared])) if file.exists()]
        return found

    def _template(self, process: str) -> Path:
        return self.root / FOLDER / f"bodyschema-{process}@.service"

    def _own(self, process: str) -> Path:
        return self.root / FOLDER / f"bodyschema-{process}@{self.robot}.service.d" / OWN

    def _systemctl(self, *arguments: str) -> None:
        if self.root == ROOT:
            self.run(["systemctl", *arguments])

    def _refused(self, file: Path, error: OSError, option: str) -> ConfigError:
        remedy = f'Type: sudo "$(command -v bodyschema)" install service --yes{option}'
        if os.geteuid() == 0:
            remedy = "Look at the file system of that folder"
        return ConfigError(f"cannot be changed: {error.strerror}", file=file, remedy=remedy)


def user_for(given: str | None) -> str:
    """Who the units are to run as: who was named, else who called sudo, else who this is.

    Raises:
        ConfigError: there is no such user, or it would be root, or nobody, who owns what is nobody's.
    """
    name = given or os.environ.get("SUDO_USER") or pwd.getpwuid(os.geteuid()).pw_name
    if name in ("root", "nobody"):
        raise ConfigError(f"the service is not to run as {name}", remedy="Name another user with --user")
    try:
        pwd.getpwnam(name)
    except KeyError as error:
        remedy = f"Make one (`sudo useradd --system {name}`), or name another with --user"
        raise ConfigError(f"there is no user {name!r} on this machine", remedy=remedy) from error
    return name


def systemd_version() -> int:
    """Of this machine's systemd, or the oldest that the units are for."""
    if shutil.which("systemctl") is None:
        return OLDEST_SYSTEMD
    said = subprocess.run(["systemctl", "--version"], capture_output=True, text=True, check=False, timeout=10).stdout
    found = re.match(r"systemd (\d+)", said)
    return OLDEST_SYSTEMD if found is None else int(found[1])
