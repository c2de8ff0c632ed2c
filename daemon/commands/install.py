"""`bodyschema install`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import cyclopts
from cyclopts import Parameter

from daemon.commands.options import HERE, RobotFile, flag

if TYPE_CHECKING:
    from rich.console import Console

    from daemon.service_files import ServiceFiles
    from daemon.udev import Rules

Root = Annotated[Path, Parameter(help="Of the file system, for images of other machines.")]

install = cyclopts.App(
    name="install",
    help="""What this machine has to know: of serial adapters, and of sampler and learner as services.

    Needs: the right to write to /etc (sudo).

    Next: `bodyschema install udev --dry-run` and `bodyschema install service --dry-run` show what they would write.
    """,
)


@install.command(sort_key=1)
def udev(
    *,
    yes: Annotated[bool, flag("Do not ask.")] = False,
    dry_run: Annotated[bool, flag("Show, and change nothing.")] = False,
    uninstall: Annotated[bool, flag("Remove the rules.")] = False,
    root: Root = Path("/"),
) -> None:
    """Rules for udev: servo adapters may be opened, and do not keep bytes back. Shows them, asks, then writes them.

    Needs: the right to write to /etc/udev/rules.d, by sudo.

    Next: plug the adapter in again; `bodyschema doctor`.
    """
    from rich.console import Console
    from rich.prompt import Confirm

    from daemon.udev import Rules, rules

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
    console.print("Written. Plug the adapter in again; `bodyschema doctor` tells whether all is well.")


@install.command(sort_key=2)
def service(
    *,
    robot: RobotFile = HERE,
    user: Annotated[
        str | None, Parameter(help="Who the services run as; else who called sudo.", show_default=False)
    ] = None,
    only: Annotated[
        Literal["sampler", "learner"] | None,
        Parameter(help="One of the two, where the other runs on another machine.", show_default=False),
    ] = None,
    yes: Annotated[bool, flag("Do not ask.")] = False,
    dry_run: Annotated[bool, flag("Show, and change nothing.")] = False,
    uninstall: Annotated[bool, flag("Stop the robot's services and remove them; its pairs stay.")] = False,
    root: Root = Path("/"),
) -> None:
    """Units for systemd: sampler and learner of this robot from boot on, started again when they fail, sandboxed.

    The sampler may open the ports and cameras that robot.toml names and nothing else: install again when they are
    others. State is kept in /var/lib/bodyschema/ROBOT unless robot.toml says where.

    Needs: robot.toml that `bodyschema run` works with, and the right to write to /etc/systemd/system, by sudo.

    Next: the `systemctl enable --now` that it prints; docs/operation.md has logs, upgrades and backups.
    """
    from rich.console import Console
    from rich.prompt import Confirm

    from daemon.config import Config
    from daemon.service_files import ServiceFiles, systemd_version, user_for
    from daemon.units import PROCESSES, Installed
    from daemon.wiring import check_sources

    console = Console(highlight=False, soft_wrap=True)
    config = Config.load(robot)
    files = ServiceFiles(config.robot.name, PROCESSES if only is None else (only,), root)
    if uninstall:
        _uninstall_service(console, files, yes=yes, dry_run=dry_run)
        return
    if only != "learner":
        check_sources(config, sim=False)
    if only != "sampler":
        config.require_learnable()
    texts = files.texts(config, user_for(user), Installed.here(systemd_version()))
    changes = files.changes(texts)
    for file, text in texts.items():
        console.print(f"{file}:{'' if file in changes else ' (there already)'}\n\n{text}", markup=False)
    if not changes:
        console.print("All of it is there already, as above.")
        return
    if dry_run or not (yes or Confirm.ask("Write them?", console=console, default=False)):
        console.print("Nothing was changed.")
        return
    files.install(changes)
    console.print(f"Written. Start them, now and at every boot: sudo systemctl enable --now {' '.join(files.units)}")


def _uninstall_service(console: Console, files: ServiceFiles, *, yes: bool, dry_run: bool) -> None:
    from rich.prompt import Confirm

    there = "\n".join(map(str, files.installed()))
    if not there:
        console.print(f"There is no service of {files.robot}. Nothing was changed.", markup=False)
        return
    console.print(f"To be stopped: {' '.join(files.units)}\nTo be removed:\n{there}", markup=False)
    if dry_run or not (yes or Confirm.ask("Go on?", console=console, default=False)):
        console.print("Nothing was changed.")
        return
    files.uninstall()
    console.print("Removed. Pairs and checkpoint are where they were.")


def _uninstall(console: Console, of_machine: Rules, *, yes: bool, dry_run: bool) -> None:
    from rich.prompt import Confirm

    if dry_run:
        there = "would be removed" if of_machine.file.exists() else "is not there"
        console.print(f"{of_machine.file} {there}. Nothing was changed.", markup=False)
        return
    if not yes and not Confirm.ask(f"Remove {of_machine.file}?", console=console, default=False):
        console.print("Nothing was changed.")
        return
    removed = of_machine.uninstall()
    console.print(f"{of_machine.file} {'removed' if removed else 'was not there'}.", markup=False)
