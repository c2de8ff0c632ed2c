"""`bodyschema status`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter


def status(
    *,
    robot: Annotated[Path, Parameter(env_var="BODYSCHEMA_ROBOT", help="The robot's description.")] = Path("robot.toml"),
    watch: Annotated[bool, Parameter(negative="", help="Go on showing it, until Ctrl-C.")] = False,
    json: Annotated[bool, Parameter(negative="", help="As JSON; null for a process that does not answer.")] = False,
) -> None:
    """Show what sampler and learner are doing: rates, rejected frames, joint coverage, errors, health.

    Needs one of them running (`bodyschema run`); exit code 1 when neither answers. With --watch --json there is one
    line about every second.
    """
    from rich.console import Console
    from rich.live import Live

    from daemon.config import Config
    from daemon.status_view import Watcher, as_json, screen

    config = Config.load(robot)
    console = Console(highlight=False)
    with Watcher(config) as watcher:
        if watch and not json:
            with Live(console=console, auto_refresh=False, screen=console.is_terminal) as live:
                for seen in watcher.follow():
                    live.update(screen(seen, config), refresh=True)
        for seen in watcher.follow() if watch else [watcher.look()]:
            if json:
                console.file.write(as_json(seen) + "\n")
                console.file.flush()
            else:
                console.print(screen(seen, config))
            if seen.nobody and not watch:
                sys.exit(1)
