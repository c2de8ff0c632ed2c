"""`bodyschema doctor`."""

from __future__ import annotations

import sys
from typing import Annotated

from rich.console import Console

from bodyschema.cli.commands.options import HERE, RobotFile, flag


def doctor(*, robot: RobotFile = HERE, json: Annotated[bool, flag("As JSON.")] = False) -> None:
    """Check ports, servos, disk, clock and zenoh; print for each problem the command that fixes it. Under 5 s.

    The servos are queried for identity and health, and read at full speed for a moment. Nothing is written to them, and
    torque stays as it is. While the sampler runs, its status is used instead. Exit code 1 if there is a problem.

    Needs: robot.toml (`bodyschema init`).

    Next: the commands in the last column; `bodyschema scan` if a servo is missing.
    """
    from bodyschema.cli.hardware.doctor import as_json, run, show
    from bodyschema.daemon.config import Config

    config = Config.load(robot)
    errors = Console(stderr=True, highlight=False)
    if errors.is_terminal:
        with errors.status("looking") as status:
            checks = run(config, lambda name: status.update(f"looking at {name}"))
    else:
        checks = run(config, lambda _: None)
    if json:
        sys.stdout.write(as_json(checks) + "\n")
    else:
        show(Console(highlight=False), checks)
    if any(check.state == "wrong" for check in checks):
        sys.exit(1)
