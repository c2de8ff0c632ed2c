"""`bodyschema restore`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bodyschema.cli.commands.options import HERE, flag


def restore(
    file: Annotated[Path, Parameter(help="What `bodyschema backup` wrote.")],
    /,
    *,
    robot: Annotated[Path, Parameter(help="Where robot.toml goes, and beside it what it names.")] = HERE,
    state_dir: Annotated[
        Path | None, Parameter(help="Where state goes; else as robot.toml says, in its folder.")
    ] = None,
    force: Annotated[bool, flag("Move what is in the way aside.")] = False,
) -> None:
    """Restore a backup: robot.toml, the files that it names, pairs and checkpoint. Verified before anything changes.

    The store gets a new identity, so that no learner mixes its new pairs with those that came after the backup.

    Needs: sampler and learner stopped.

    Next: `bodyschema run`, or `systemctl start` for the robot's services.
    """
    from rich.console import Console

    from bodyschema.cli.install.backup import Backup
    from bodyschema.cli.install.restore import restore as put_back

    console = Console(highlight=False, soft_wrap=True)
    with Backup(file) as opened:
        made = opened.manifest
        done = put_back(opened, robot, state_dir, force=force)
    text = f"{made.robot} as it was at {made.written_utc}: {made.pairs} pairs to number {made.last_seq}"
    console.print(text, markup=False)
    if done.unreadable:
        console.print(f"  {done.unreadable} pairs between could not be read when it was written", markup=False)
    for written in done.written:
        console.print(f"  {written}", markup=False)
    for aside in done.aside:
        console.print(f"  what was there before is {aside}", markup=False)
    for origin, target in done.elsewhere.items():
        console.print(f"  robot.toml names {origin}: put {target} there, or fix robot.toml", markup=False)
    console.print("A learner on another machine takes the pairs as those of another store: tell it reset_to_prior.")
