"""`bodyschema install`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from rich.prompt import Confirm

from bodyschema.cli.commands.options import HERE, VARIABLE, flag, say, several
from bodyschema.interfaces.errors import ConfigError

if TYPE_CHECKING:
    from bodyschema.cli.install.machine_files import MachineFiles

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
    uninstall: Annotated[bool, flag("Stop the services and remove them, or remove the rules; samples stay.")] = False,
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
        from bodyschema.cli.install.machine_files import UdevRules

        rules = UdevRules(root)
        if uninstall:
            _remove(rules, yes=yes, dry_run=dry_run)
        else:
            _written(rules, rules.texts(), yes=yes, dry_run=dry_run)
    elif what == "router":
        _router(file, user, root, uninstall=uninstall, yes=yes, dry_run=dry_run)
    else:
        _service(robot, user, only, name, root, uninstall=uninstall, yes=yes, dry_run=dry_run)


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
    from bodyschema.cli.install.service_files import ServiceFiles, make_state_folders, systemd_version, user_for
    from bodyschema.cli.install.units import PROCESSES, Installed
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.learner.host import session_settings
    from bodyschema.daemon.wiring.wiring import check_sources
    from bodyschema.fleet.hosting import configs_of, descriptions

    files = descriptions(robot or (Path(os.environ.get(VARIABLE, HERE)),))
    several_robots = len(files) > 1
    if several_robots and only == "sampler":
        raise ConfigError(
            "each robot has a sampler of its own", remedy="Install them one by one, each with its --robot"
        )
    if several_robots:
        units = ServiceFiles(name, ("learner",), root)
    else:
        units = ServiceFiles(Config.load(files[0]).robot.name, PROCESSES if only is None else (only,), root)
    if uninstall:
        _remove(units, yes=yes, dry_run=dry_run)
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
    if _written(units, texts, yes=yes, dry_run=dry_run):
        make_state_folders(configs, user_for(user), root)


def _router(file: Path, user: str | None, root: Path, *, uninstall: bool, yes: bool, dry_run: bool) -> None:
    from bodyschema.cli.install.router import RouterConfig
    from bodyschema.cli.install.service_files import RouterFiles, systemd_version, user_for
    from bodyschema.cli.install.units import Installed

    units = RouterFiles(root)
    if uninstall:
        _remove(units, yes=yes, dry_run=dry_run)
        return
    texts = units.texts(RouterConfig.load(file), user_for(user), Installed.here(systemd_version()))
    _written(units, texts, yes=yes, dry_run=dry_run)


def _written(files: MachineFiles, texts: dict[Path, str], *, yes: bool, dry_run: bool) -> bool:
    """Show the files, and write them if that is confirmed; return True if they are installed now."""
    from bodyschema.cli.install.machine_files import missing

    changes = missing(texts)
    for file, text in texts.items():
        say(f"{file}:{'' if file in changes else ' (there already)'}\n\n{text}")
    if not changes:
        say("All of it is there already, as above.")
        return not dry_run
    if dry_run or not (yes or Confirm.ask("Write it?", default=False)):
        say("Nothing was changed.")
        return False
    files.install(changes)
    say(f"Written. {files.is_used}")
    return True


def _remove(files: MachineFiles, *, yes: bool, dry_run: bool) -> None:
    """Show the files and the services that use them, and remove them if that is confirmed."""
    there = files.installed()
    if not there:
        say(f"`bodyschema install {files.kind}` has installed nothing here. Nothing was changed.")
        return
    say(*files.before_removal, "To be removed:", *map(str, there))
    if dry_run or not (yes or Confirm.ask("Go on?", default=False)):
        say("Nothing was changed.")
        return
    files.uninstall()
    say(f"Removed. {files.stays}".rstrip())
