"""`bodyschema learner`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from daemon.commands.options import HERE, RobotFile, flag


def learner(
    *,
    robot: RobotFile = HERE,
    state_dir: Annotated[Path | None, Parameter(help="Where the checkpoint lives; else as robot.toml says.")] = None,
    view: Annotated[bool, flag("Show the page of `bodyschema view` too, as a process of its own.")] = False,
    verbose: Annotated[bool, flag("Log more.")] = False,
) -> None:
    """Learn the robot's kinematics and answer queries. Ends with SIGTERM or Ctrl-C.

    New pairs come from the sampler, on this machine or another; without one the learner answers from what it knows.

    Needs: robot.toml (`bodyschema config init`), and for new pairs `bodyschema sampler`.

    Next: `bodyschema predict`, `bodyschema status`.
    """
    # Before numpy is loaded: its threads would fight with each other and with the answers for the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from contextlib import nullcontext

    from daemon import logs
    from daemon.config import Config
    from daemon.learner import run_learner
    from daemon.notify import Notifier
    from daemon.signals import Wishes, on_termination
    from daemon.view_process import require_extra, shown
    from interfaces.clock import SystemClock

    if view:
        require_extra()
    logs.set_up(verbose=verbose)
    notifier = Notifier.of_environment()
    config = Config.load(robot)
    config.require_learnable()
    if state_dir is not None:
        config = config.with_state_dir(state_dir)
    wishes = Wishes()
    # In a terminal SIGHUP says that it was closed.
    reload = wishes.reload if notifier.is_heard else None
    with shown(robot) if view else nullcontext(), on_termination(wishes.end, reload=reload):
        run_learner(config, SystemClock(), wishes, notifier)
