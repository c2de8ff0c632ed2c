"""Write, show and remove the files of a machine's services as a unit."""

from __future__ import annotations

import os
import pwd
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from bodyschema.daemon.config import Config
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.description import NAME

from .udev import ROOT, run_quietly
from .units import FOLDER, LEARNER_OF, OWN, PROCESSES, ROUTER, Installed, of_host, of_robot, of_router, template

if TYPE_CHECKING:
    from .router import RouterConfig

Run = Callable[[Sequence[str]], None]
OLDEST_SYSTEMD = 252  # assumed where the version is not queried


@dataclass(frozen=True, slots=True)
class UnitFolder:
    """The folder of a machine's units.

    Attributes:
        root: root of the machine's file system.
        run: runs a command; only if `root` is this machine's.
    """

    root: Path = ROOT
    run: Run = run_quietly

    @property
    def path(self) -> Path:
        return self.root / FOLDER

    def write(self, texts: dict[Path, str], command: str) -> None:
        """Write the files, and let systemd reload them.

        Args:
            command: the command line of `bodyschema` for the remedy in an error.

        Raises:
            ConfigError: a file cannot be written.
        """
        for file, text in texts.items():
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text, encoding="utf-8")
            except OSError as error:
                raise _refused(file, error, command) from error
        self._systemctl("daemon-reload")

    def remove(self, units: Sequence[str], files: Sequence[Path], command: str) -> None:
        """Stop the units, and remove the files and the folders that become empty.

        Raises:
            ConfigError: a file cannot be removed.
        """
        if not files:
            return
        self._systemctl("disable", "--now", *units)
        for file in files:
            try:
                file.unlink()
                if file.name == OWN and not any(file.parent.iterdir()):  # `systemctl edit` puts the user's files there
                    file.parent.rmdir()
            except OSError as error:
                raise _refused(file, error, f"{command} --uninstall") from error
        self._systemctl("daemon-reload")

    def _systemctl(self, *arguments: str) -> None:
        if self.root == ROOT:
            self.run(["systemctl", *arguments])


class UnitFiles(Protocol):
    """The units of a service on a machine, written, shown and removed together."""

    @property
    def units(self) -> list[str]:
        """Names of the units."""
        ...

    def install(self, texts: dict[Path, str]) -> None:
        """Write the files, and let systemd reload them. ConfigError: a file cannot be written."""
        ...

    def uninstall(self) -> list[Path]:
        """Stop and remove the units; return the removed files. ConfigError: a file cannot be removed."""
        ...

    def installed(self) -> list[Path]:
        """Return the files that `uninstall` would remove."""
        ...


@dataclass(frozen=True, slots=True)
class ServiceFiles:
    """The units of one robot, or of the learner of several.

    Attributes:
        name: name of the robot, or of the learner of several.
        processes: sampler, learner or both.
        folder: folder of the units.
    """

    name: str
    processes: Sequence[str] = PROCESSES
    folder: UnitFolder = UnitFolder()

    def __post_init__(self) -> None:
        if not re.match(NAME, self.name):
            remedy = "Take letters, digits, _ . and -, and begin with a letter, a digit or _"
            raise ConfigError(f"{self.name!r} is no name for a service", remedy=remedy)

    @property
    def units(self) -> list[str]:
        return [f"bodyschema-{process}@{self.name}.service" for process in self.processes]

    def texts(self, config: Config, user: str, installed: Installed) -> dict[Path, str]:
        """Return the contents of each file for one robot.

        Raises:
            ConfigError: its learner is one of several robots on this machine already.
        """
        if "learner" in self.processes:
            self._refuse_second_learner(config)
        own = {process: of_robot(process, config, user, installed) for process in self.processes}
        return self._texts(own, installed)

    def texts_of_host(self, configs: Sequence[Config], user: str, installed: Installed) -> dict[Path, str]:
        """Return the contents of each file for the learner of several robots.

        Raises:
            ConfigError: the learner has the name of one of them, or one has a learner here already.
        """
        for config in configs:
            if config.robot.name == self.name:
                raise ConfigError(f"{self.name} is one of the robots", remedy="Give their learner another --name")
            self._refuse_second_learner(config)
        return self._texts({"learner": of_host(configs, user, installed)}, installed)

    def install(self, texts: dict[Path, str]) -> None:
        self.folder.write(texts, "install service")

    def uninstall(self) -> list[Path]:
        """Remove this robot's units, and with the last robot the templates."""
        there = self.installed()
        self.folder.remove(self.units, there, "install service")
        return there

    def installed(self) -> list[Path]:
        found: list[Path] = []
        for process in self.processes:
            own, shared = self._own(process, self.name), self._template(process)
            others = [
                file
                for file in self.folder.path.glob(f"bodyschema-{process}@*.service.d/*")
                if file.parent != own.parent
            ]
            found += [file for file in (own, *([] if others else [shared])) if file.exists()]
        return found

    def _refuse_second_learner(self, config: Config) -> None:
        robot = config.robot.name
        for file in self.folder.path.glob(f"bodyschema-learner@*.service.d/{OWN}"):
            name = file.parent.name.removeprefix("bodyschema-learner@").removesuffix(".service.d")
            first = file.read_text("utf-8").partition("\n")[0]
            learnt = first.removeprefix(LEARNER_OF).split() if first.startswith(LEARNER_OF) else [name]
            if name != self.name and robot in learnt:
                raise ConfigError(
                    f"{robot} has a learner on this machine already, bodyschema-learner@{name}",
                    file=file,
                    remedy="Two would learn it: install one of them with --uninstall first",
                )

    def _texts(self, own: dict[str, str], installed: Installed) -> dict[Path, str]:
        texts: dict[Path, str] = {}
        for process, text in own.items():
            texts |= {self._template(process): template(process, installed), self._own(process, self.name): text}
        return texts

    def _template(self, process: str) -> Path:
        return self.folder.path / f"bodyschema-{process}@.service"

    def _own(self, process: str, name: str) -> Path:
        return self.folder.path / f"bodyschema-{process}@{name}.service.d" / OWN


@dataclass(frozen=True, slots=True)
class RouterFiles:
    """The unit of the router."""

    folder: UnitFolder = UnitFolder()

    @property
    def units(self) -> list[str]:
        return [ROUTER]

    def texts(self, config: RouterConfig, user: str, installed: Installed) -> dict[Path, str]:
        """Return the contents of its file."""
        return {self.folder.path / ROUTER: of_router(config, user, installed)}

    def install(self, texts: dict[Path, str]) -> None:
        self.folder.write(texts, "install router")

    def uninstall(self) -> list[Path]:
        there = self.installed()
        self.folder.remove(self.units, there, "install router")
        return there

    def installed(self) -> list[Path]:
        file = self.folder.path / ROUTER
        return [file] if file.exists() else []


def make_state_folders(configs: Sequence[Config], user: str, root: Path = ROOT) -> None:
    """Create each `state_dir` that a robot.toml names, owned by `user`; systemd itself creates the others.

    Raises:
        ConfigError: a folder cannot be created.
    """
    for config in configs:
        folder = root / os.path.abspath(config.state_dir).lstrip("/")
        if config.tables.daemon.state_dir is None or folder.exists():
            continue
        made = [path for path in (folder, *folder.parents) if not path.exists()]
        try:
            folder.mkdir(0o750, parents=True)
            for path in made if os.geteuid() == 0 else ():
                shutil.chown(path, user)
        except OSError as error:
            raise _refused(folder, error, "install service") from error


def missing(texts: dict[Path, str]) -> dict[Path, str]:
    """Return those files that do not exist with these contents."""
    return {file: text for file, text in texts.items() if not file.exists() or file.read_text("utf-8") != text}


def _refused(file: Path, error: OSError, command: str) -> ConfigError:
    remedy = f'Type: sudo "$(command -v bodyschema)" {command} --yes'
    if os.geteuid() == 0:
        remedy = "Look at the file system of that folder"
    return ConfigError(f"cannot be changed: {error.strerror}", file=file, remedy=remedy)


def user_for(given: str | None) -> str:
    """Return the user to run a service as: the given one, else the one who called sudo, else the current one.

    Raises:
        ConfigError: there is no such user, or it would be root or the user "nobody".
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
    """Return this machine's systemd version, or the oldest that the units support."""
    if shutil.which("systemctl") is None:
        return OLDEST_SYSTEMD
    said = subprocess.run(["systemctl", "--version"], capture_output=True, text=True, check=False, timeout=10).stdout
    found = re.match(r"systemd (\d+)", said)
    return OLDEST_SYSTEMD if found is None else int(found[1])
