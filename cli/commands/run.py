"""`bodyschema run`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bodyschema.cli.commands.options import HERE, RobotFile, flag


def run(
    *,
    robot: RobotFile = HERE,
    sim: Annotated[bool, flag("The simulated robot in the place of the hardware.")] = False,
    state_dir: Annotated[Path | None, Parameter(help="Where state lives; else as robot.toml says.")] = None,
    view: Annotated[bool, flag("Show the page of `bodyschema view` too.")] = False,
    verbose: Annotated[bool, flag("Log more.")] = False,
) -> None:
    """Start sampler and learner as separate processes, and restart one that dies. Ctrl-C ends both.

    Needs: robot.toml (`bodyschema init`), and --sim or a recording named in its table [drivers].

    Next: in another terminal, `bodyschema status --watch`, `bodyschema view` and `bodyschema predict`.
    """
    from contextlib import nullcontext

    from bodyschema.cli.terminal.view_process import shown
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.service import logs
    from bodyschema.daemon.service.signals import on_termination
    from bodyschema.daemon.service.supervise import Child, Supervisor
    from bodyschema.daemon.wiring.wiring import check_sources
    from bodyschema.interfaces.extras import require_extra
    from bodyschema.interfaces.interpreter import module_command

    if view:
        require_extra("view", "the page")
    logs.set_up(verbose=verbose)
    config = Config.load(robot)
    config.require_learnable()
    check_sources(config, sim=sim)
    options = ["--robot", str(robot), *(["--state-dir", str(state_dir)] if state_dir else [])]
    options += ["--verbose"] if verbose else []
    sampler = Child("sampler", module_command("bodyschema", "sampler", *options, *(["--sim"] if sim else [])))
    learner = Child("learner", module_command("bodyschema", "learner", *options))
    supervisor = Supervisor([sampler, learner])
    with shown(robot) if view else nullcontext(), on_termination(supervisor.stop):
        supervisor.run()
