"""`bodyschema install`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.prompt import Confirm

from bodyschema.cli.commands.options import HERE, VARIABLE, flag, several
from bodyschema.interfaces.errors import ConfigError

if TYPE_CHECKING:
    from bodyschema.cli.install.service_files import UnitFiles
    from bodyschema.cli.install.udev import Rules

Root = Annotated[Path, Parameter(help="Of the file system, for images of other machines.")]


def install(
    what: Annotated[
        Literal["service", "udev", "router"],
        Parameter(help="This robot's sampler and learner; rules for serial adapters; the zenoh router."),
    ],
    file: Annotated[Path, Parameter(help="Of the router: who may connect, and do what.")] = Path("router.toml"),
    /,
    *,
    robot: Annotated[
        tuple[Path, ...],
        several(f"Of the service: the robot's description, or a folder of them; else {VARIABLE} or robot.toml"),
    ] = (),
    user: Annotated[
        str | None, Parameter(help="The user that a service runs as; else the one who called sudo.", show_default=False)
    ] = None,
    only: Annotated[
        Literal["sampler", "learner"] | None,
        Parameter(help="One of the two services, where the other runs on another machine.", show_default=False),
    ] = None,
    name: Annotated[str, Parameter(help="Name of the learner of several robots.")] = "fleet",
    yes: Annotated[bool, flag("Do not ask.")] = False,
    dry_run: Annotated[bool, flag("Show, and change nothing.")] = False,
    uninstall: Annotated[bool, flag("Stop the services and remove them, or remove the rules; pairs stay.")] = False,
    root: Root = Path("/"),
) -> None:
    """Install systemd services or udev rules. Shows what it would write, and asks first.

    `service`: sampler and learner of this robot from boot on, restarted on failure, sandboxed. The sampler may open
    only the ports and cameras that robot.toml names; install again when they change. State is kept in
    /var/lib/bodyschema/ROBOT unless robot.toml names another folder. For several robots, one learner serves them all;
    their samplers are installed on the robots' machines.

    `udev`: rules that let you open servo adapters and reduce their latency.

    `router`: the zenoh router from boot on, restarted on failure, sandboxed.

    Needs: the right to write to /etc (sudo); robot.toml that works with `bodyschema run`, or router.toml that works
    with `bodyschema router` and keys that --user can read.

    Next: the `systemctl enable --now` that it prints, or plug the adapter in again; then `bodyschema doctor`.
    docs/operation.md describes logs, upgrades and backups.
    """
    if what == "udev":
        _udev(root, uninstall=uninstall, yes=yes, dry_run=dry_run)
    elif what == "router":
        _router(file, user, root, uninstall=uninstall, yes=yes, dry_run=dry_run)
    else:
        _service(robot, user, only, name, root, uninstall=uninstall, yes=yes, dry_run=dry_run)


def _udev(root: Path, *, uninstall: bool, yes: bool, dry_run: bool) -> None:

    from bodyschema.cli.install.udev import Rules, rules

    console = Console(highlight=False, soft_wrap=True)
    of_machine = Rules(root)
    if uninstall:
        _uninstall(console, of_machine, yes=yes, dry_run=dry_run)
        return
    console.print(f"{of_machine.file}:", markup=False)
    console.print(rules(), markup=False)
    if of_machine.is_current:
        console.print("It is there already, as above.")
        return
    if dry_run:
        console.print("Nothing was changed.")
        return
    if not yes and not Confirm.ask("Write it?", console=console, default=False):
        console.print("Nothing was changed.")
        return
    of_machine.install()
    console.print("Written. Plug the adapter in again; `bodyschema doctor` checks it.")


def _service(
    robot: tuple[Path, ...],
    user: str | None,
    only: Literal["sampler", "learner"] | None,
    name: str,
    root: Path,
    *,
    uninstall: bool,
    yes: bool,
    dry_run: bool,
) -> None:
    from bodyschema.cli.install.service_files import (
        ServiceFiles,
        UnitFolder,
        make_state_folders,
        systemd_version,
        user_for,
    )
    from bodyschema.cli.install.units import PROCESSES, Installed
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.learner.host import session_settings
    from bodyschema.daemon.wiring.wiring import check_sources
    from bodyschema.fleet.hosting import configs_of, descriptions

    files, folder = descriptions(robot or (Path(os.environ.get(VARIABLE, HERE)),)), UnitFolder(root)
    several_robots = len(files) > 1
    if several_robots and only == "sampler":
        raise ConfigError(
            "each robot has a sampler of its own", remedy="Install them one by one, each with its --robot"
        )
    if several_robots:
        units = ServiceFiles(name, ("learner",), folder)
    else:
        units = ServiceFiles(Config.load(files[0]).robot.name, PROCESSES if only is None else (only,), folder)
    if uninstall:
        _uninstall_units(units, "Removed. Pairs and checkpoints are where they were.", yes=yes, dry_run=dry_run)
        return
    installed = Installed.here(systemd_version())
    if several_robots:
        configs = configs_of(files, None)
        session_settings(configs)  # refuses robots that one learner cannot serve
        texts = units.texts_of_host(configs, user_for(user), installed)
    else:
        configs = [config := Config.load(files[0])]
        if only != "learner":
            check_sources(config, sim=False)
        if only != "sampler":
            config.require_learnable()
        texts = units.texts(config, user_for(user), installed)
    if _install_units(units, texts, yes=yes, dry_run=dry_run):
        make_state_folders(configs, user_for(user), root)


def _router(file: Path, user: str | None, root: Path, *, uninstall: bool, yes: bool, dry_run: bool) -> None:
    from bodyschema.cli.install.router import RouterConfig
    from bodyschema.cli.install.service_files import RouterFiles, UnitFolder, systemd_version, user_for
    from bodyschema.cli.install.units import Installed

    units = RouterFiles(UnitFolder(root))
    if uninstall:
        _uninstall_units(units, "Removed. router.toml and keys are where they were.", yes=yes, dry_run=dry_run)
        return
    texts = units.texts(RouterConfig.load(file), user_for(user), Installed.here(systemd_version()))
    _install_units(units, texts, yes=yes, dry_run=dry_run)


def _install_units(units: UnitFiles, texts: dict[Path, str], *, yes: bool, dry_run: bool) -> bool:
    """Return True if they are installed now."""

    from bodyschema.cli.install.service_files import missing

    console = Console(highlight=False, soft_wrap=True)
    changes = missing(texts)
    for file, text in texts.items():
        console.print(f"{file}:{'' if file in changes else ' (there already)'}\n\n{text}", markup=False)
    if not changes:
        console.print("All of it is there already, as above.")
        return not dry_run
    if dry_run or not (yes or Confirm.ask("Write it?", console=console, default=False)):
        console.print("Nothing was changed.")
        return False
    units.install(changes)
    console.print(f"Written. Start it, now and at every boot: sudo systemctl enable --now {' '.join(units.units)}")
    return True


def _uninstall_units(units: UnitFiles, removed: str, *, yes: bool, dry_run: bool) -> None:
    console = Console(highlight=False, soft_wrap=True)
    there = "\n".join(map(str, units.installed()))
    if not there:
        console.print(f"There is no {' '.join(units.units)}. Nothing was changed.", markup=False)
        return
    console.print(f"To be stopped: {' '.join(units.units)}\nTo be removed:\n{there}", markup=False)
    if dry_run or not (yes or Confirm.ask("Go on?", console=console, default=False)):
        console.print("Nothing was changed.")
        return
    units.uninstall()
    console.print(removed)


def _uninstall(console: Console, of_machine: Rules, *, yes: bool, dry_run: bool) -> None:
    if dry_run:
        there = "would be removed" if of_machine.file.exists() else "is not there"
        console.print(f"{of_machine.file} {there}. Nothing was changed.", markup=False)
        return
    if not yes and not Confirm.ask(f"Remove {of_machine.file}?", console=console, default=False):
        console.print("Nothing was changed.")
        return
    removed = of_machine.uninstall()
    console.print(f"{of_machine.file} {'removed' if removed else 'was not there'}.", markup=False)
