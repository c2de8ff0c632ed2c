"""`bodyschema install`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import cyclopts
from cyclopts import Parameter

from daemon.commands.options import flag

if TYPE_CHECKING:
    from rich.console import Console

    from daemon.udev import Rules

install = cyclopts.App(
    name="install",
    help="""What this machine has to know of serial adapters.

    Needs: the right to write to /etc (sudo).

    Next: `bodyschema install udev --dry-run` shows what it would write.
    """,
)


@install.command(sort_key=1)
def udev(
    *,
    yes: Annotated[bool, flag("Do not ask.")] = False,
    dry_run: Annotated[bool, flag("Show, and change nothing.")] = False,
    uninstall: Annotated[bool, flag("Remove the rules.")] = False,
    root: Annotated[Path, Parameter(help="Of the file system, for images of other machines.")] = Path("/"),
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
