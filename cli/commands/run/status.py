"""`bodyschema status`."""

from __future__ import annotations

import sys
from typing import Annotated

from rich.console import Console

from bodyschema.cli.commands.options import HERE, RobotFile, flag


def status(
    *,
    robot: RobotFile = HERE,
    watch: Annotated[bool, flag("Go on showing it, until Ctrl-C.")] = False,
    json: Annotated[bool, flag("As JSON; null for a process that does not answer.")] = False,
) -> None:
    """Show what sampler and learner are doing: rates, rejected frames, joint coverage, errors, health.

    With --watch --json, prints one line about every second. Exit code 1 if neither answers.

    Needs: one of them running (`bodyschema run`).

    Next: `bodyschema command` to pause, or to report a tool change; `bodyschema predict`.
    """
    from bodyschema.cli.terminal.status_view import Watcher, as_json, screen
    from bodyschema.daemon.client_config import ClientConfig
    from bodyschema.interfaces.errors import BusError

    config = ClientConfig.load(robot)
    console = Console(highlight=False)
    with Watcher(config) as watcher:
        if watch and not json:
            from rich.live import Live

            with Live(console=console, auto_refresh=False, screen=console.is_terminal) as live:
                for seen in watcher.follow():
                    live.update(screen(seen, config), refresh=True)
        for seen in watcher.follow() if watch else [watcher.look()]:
            if json:
                console.file.write(as_json(seen) + "\n")
                console.file.flush()
            if not json:
                console.print(screen(seen, config))
            if seen.nobody and not watch:
                if fault := config.fault():  # `Start it` would be no remedy
                    raise BusError(fault)
                sys.exit(1)
