"""`bodyschema backup`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bodyschema.cli.commands.options import HERE, RobotFile, flag


def backup(
    file: Annotated[Path, Parameter(help="The file to write, as in left_arm.zip.")],
    /,
    *,
    robot: RobotFile = HERE,
    state_dir: Annotated[Path | None, Parameter(help="Where state lives; else as robot.toml says.")] = None,
    force: Annotated[bool, flag("Replace the file if it is there.")] = False,
) -> None:
    """Copy pairs, checkpoint, robot.toml and the files that it names into one file; works while all of it runs.

    It is a ZIP archive with a checksum of every file, and only you can read it: robot.toml may hold passwords.

    Needs: a store (`bodyschema sampler` creates it).

    Next: `bodyschema restore` on this or another machine.
    """
    from importlib.metadata import version

    from rich.console import Console

    from bodyschema.cli.install.backup import write_backup
    from bodyschema.daemon.config import Config
    from bodyschema.interfaces.clock import SystemClock

    config = Config.load(robot)
    if state_dir is not None:
        config = config.with_state_dir(state_dir)
    made = write_backup(config, file, utc=SystemClock().utc(), version=version("bodyschema"), replace=force)
    learnt = "" if any(name.endswith(".ckpt") for name in made.files) else ", no checkpoint yet"
    console = Console(highlight=False, soft_wrap=True)
    console.print(
        f"{file}: {made.robot}, {made.pairs} pairs to number {made.last_seq}{learnt}, "
        f"{file.stat().st_size / 1e6:.1f} MB",
        markup=False,
    )
    if made.unreadable:
        console.print(
            f"{made.unreadable} pairs cannot be read and are not in it: the disk changed what was written. Check the "
            "disk; `bodyschema doctor` tells their numbers",
            markup=False,
        )
