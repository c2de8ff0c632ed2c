"""`bodyschema doctor`."""

from __future__ import annotations

import sys
from typing import Annotated

from bodyschema.daemon.commands.options import HERE, RobotFile, flag


def doctor(*, robot: RobotFile = HERE, json: Annotated[bool, flag("As JSON.")] = False) -> None:
    """What is wrong with ports, servos, disk, clock or zenoh, each with the command that mends it. Under 5 s.

    The servos are asked who they are and how they are, and are read as fast as it goes for a moment. Nothing is written
    to them, and torque stays as it is. While the sampler runs, it tells instead. Exit code 1 when something is wrong.

    Needs: robot.toml (`bodyschema config init`).

    Next: what the last column says; `bodyschema scan` when a servo is missing.
    """
    from rich.console import Console

    from bodyschema.daemon.config import Config
    from bodyschema.daemon.doctor import as_json, run
    from bodyschema.daemon.doctor_view import show

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
