"""`bodyschema backup`."""

from __future__ import annotations

import os
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bodyschema.cli.commands.options import HERE, VARIABLE, flag, print_json, say
from bodyschema.interfaces.clock import SystemClock


def backup(
    file: Annotated[Path, Parameter(help="The file to write, as in left_arm.zip, or to restore.")],
    /,
    *,
    restore: Annotated[bool, flag("Put what FILE holds back, instead of writing it.")] = False,
    robot: Annotated[
        Path | None,
        Parameter(
            show_default=False,
            help=f"The robot's description; else {VARIABLE} or robot.toml. With --restore: where it goes; else here.",
        ),
    ] = None,
    state_dir: Annotated[
        Path | None, Parameter(help="Where state lives, or goes; else as robot.toml says, in its folder.")
    ] = None,
    force: Annotated[bool, flag("Replace FILE if it is there; with --restore, move what is in the way aside.")] = False,
    as_json: Annotated[bool, flag("Print the result as JSON.", name="--json")] = False,
) -> None:
    """Copy samples, checkpoint, robot.toml and the files that it names into one file, or restore such a file.

    A backup can be written while sampler and learner run. It is a ZIP archive with a checksum of every file, and only
    you can read it: robot.toml may hold passwords.

    --restore verifies the whole file before anything changes; existing files are kept. The store gets a new identity,
    so that no learner mixes its new samples with those that came after the backup.

    Needs: a store (`bodyschema run` creates it); with --restore, sampler and learner stopped.

    Next: `bodyschema backup FILE --restore` on this or another machine; after it `bodyschema run`, or `systemctl start`
    for the robot's services.
    """
    if restore:
        _restore(file, robot or HERE, state_dir, force=force, as_json=as_json)
    else:
        _write(file, robot or Path(os.environ.get(VARIABLE, HERE)), state_dir, force=force, as_json=as_json)


def _write(file: Path, robot: Path, state_dir: Path | None, *, force: bool, as_json: bool) -> None:
    from bodyschema.cli.install.backup import write_backup
    from bodyschema.daemon.config import Config

    config = Config.load(robot)
    if state_dir is not None:
        config = config.with_state_dir(state_dir)
    made = write_backup(config, file, utc=SystemClock().utc(), version=version("bodyschema"), replace=force)
    if as_json:
        unreadable = {"unreadable": made.unreadable}
        print_json(
            {"file": str(file), "robot": made.robot, "pairs": made.pairs, "last_seq": made.last_seq, **unreadable}
        )
        return
    learnt = "" if any(name.endswith(".ckpt") for name in made.files) else ", no checkpoint yet"
    size = file.stat().st_size / 1e6
    say(f"{file}: {made.robot}, {made.pairs} samples to number {made.last_seq}{learnt}, {size:.1f} MB")
    if made.unreadable:
        say(
            f"{made.unreadable} samples cannot be read and are not in it: the disk changed what was written. Check the "
            "disk; `bodyschema doctor` lists their numbers"
        )


def _restore(file: Path, robot: Path, state_dir: Path | None, *, force: bool, as_json: bool) -> None:
    from bodyschema.cli.install.backup import Backup
    from bodyschema.cli.install.restore import restore

    with Backup(file) as opened:
        made = opened.manifest
        done = restore(opened, robot, state_dir, force=force)
    if as_json:
        aside = {"aside": list(map(str, done.aside)), "elsewhere": {str(a): str(b) for a, b in done.elsewhere.items()}}
        print_json({"robot": made.robot, "pairs": made.pairs, "written": list(map(str, done.written)), **aside})
        return
    say(f"{made.robot} as it was at {made.written_utc}: {made.pairs} samples to number {made.last_seq}")
    if done.unreadable:
        say(f"  {done.unreadable} samples between could not be read when it was written")
    say(*(f"  {written}" for written in done.written))
    say(*(f"  what was there before is {aside}" for aside in done.aside))
    say(
        *(
            f"  robot.toml names {origin}: put {target} there, or fix robot.toml"
            for origin, target in done.elsewhere.items()
        )
    )
    say(
        "A learner on another machine takes the samples as those of another store: send it `bodyschema command "
        "reset_to_prior`."
    )
