"""Write, show and remove the files of a machine's services as a unit."""

from __future__ import annotations

import os
import pwd
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bodyschema.daemon.config import Config
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.description import NAME

from .machine_files import ROOT, Command, MachineFiles, run_quietly, writing
from .units import FOLDER, LEARNER_OF, OWN, PROCESSES, ROUTER, Installed, of_host, of_robot, of_router, template

if TYPE_CHECKING:
    from .router import RouterConfig

OLDEST_SYSTEMD = 252  # assumed where the version is not queried


class UnitFiles(MachineFiles):
    """The units of a service, by their names."""

    reload = (("systemctl", "daemon-reload"),)

    def __init__(self, units: Sequence[str], root: Path, run: Callable[[Command], None]) -> None:
        super().__init__(root, run)
        self.units, names = units, " ".join(units)
        self.is_used = f"Start it, now and at every boot: sudo systemctl enable --now {names}"
        self.before_removal = [f"To be stopped: {names}"]

    def uninstall(self) -> None:
        """Stop the units, and remove their files; raise ConfigError if one cannot be removed."""
        self._call([("systemctl", "disable", "--now", *self.units)])
        super().uninstall()


class ServiceFiles(UnitFiles):
    """The units of one robot, or of the learner of several.

    Args:
        name: name of the robot, or of the learner of several.
        processes: sampler, learner or both.
        root, run: as in `MachineFiles`.

    Raises:
        ConfigError: the name is invalid for a service.
    """

    kind, stays = "service", "Samples and checkpoints are where they were."

    def __init__(
        self,
        name: str,
        processes: Sequence[str] = PROCESSES,
        root: Path = ROOT,
        run: Callable[[Command], None] = run_quietly,
    ) -> None:
        super().__init__([f"bodyschema-{process}@{name}.service" for process in processes], root, run)
        self.name, self.processes, self._folder = name, processes, root / FOLDER
        if not re.match(NAME, self.name):
            remedy = "Take letters, digits, _ . and -, and begin with a letter, a digit or _"
            raise ConfigError(f"{self.name!r} is no name for a service", remedy=remedy)

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

    def installed(self) -> list[Path]:
        found: list[Path] = []
        for process in self.processes:
            own, shared = self._own(process, self.name), self._template(process)
            others = [
                file for file in self._folder.glob(f"bodyschema-{process}@*.service.d/*") if file.parent != own.parent
            ]
            found += [file for file in (own, *([] if others else [shared])) if file.exists()]
        return found

    def _refuse_second_learner(self, config: Config) -> None:
        robot = config.robot.name
        for file in self._folder.glob(f"bodyschema-learner@*.service.d/{OWN}"):
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
        return self._folder / f"bodyschema-{process}@.service"

    def _own(self, process: str, name: str) -> Path:
        return self._folder / f"bodyschema-{process}@{name}.service.d" / OWN


class RouterFiles(UnitFiles):
    kind, stays = "router", "router.toml and keys are where they were."

    def __init__(self, root: Path = ROOT, run: Callable[[Command], None] = run_quietly) -> None:
        super().__init__([ROUTER], root, run)

    def texts(self, config: RouterConfig, user: str, installed: Installed) -> dict[Path, str]:
        """Return the contents of its file."""
        return {self.root / FOLDER / ROUTER: of_router(config, user, installed)}

    def installed(self) -> list[Path]:
        file = self.root / FOLDER / ROUTER
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
        created = [path for path in (folder, *folder.parents) if not path.exists()]
        with writing(folder, "install service"):
            folder.mkdir(0o750, parents=True)
            for path in created if os.geteuid() == 0 else ():
                shutil.chown(path, user)


def user_for(given: str | None) -> str:
    """Return the user of a service: the given one, otherwise the one who called sudo, otherwise the current one.

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
    output = subprocess.run(["systemctl", "--version"], capture_output=True, text=True, check=False, timeout=10).stdout
    found = re.match(r"systemd (\d+)", output)
    return OLDEST_SYSTEMD if found is None else int(found[1])
