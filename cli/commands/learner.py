"""`bodyschema learner`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import HERE, VARIABLE, flag, several


def learner(
    *,
    robot: Annotated[
        tuple[Path, ...],
        several(f"The robot's description, or a folder of them; else {VARIABLE} or robot.toml"),
    ] = (),
    processes: Annotated[int, Parameter(help="Spread the robots over so many processes.", validator=Number(gte=1))] = 1,
    state_dir: Annotated[
        Path | None,
        Parameter(help="Where the checkpoint lives (a folder each for several robots); else as robot.toml says."),
    ] = None,
    view: Annotated[bool, flag("Show the page of `bodyschema view` too, as a process of its own.")] = False,
    verbose: Annotated[bool, flag("Log more.")] = False,
) -> None:
    """Learn the robot's kinematics and answer queries. Ends with SIGTERM or Ctrl-C.

    New pairs come from the sampler, on this machine or another; without one, the learner answers from what it has
    learnt. With several robots, each pair is learnt as it arrives, and less urgent work is done in turns
    (docs/fleet.md).

    Needs: robot.toml (`bodyschema init`), and for new pairs `bodyschema sampler`.

    Next: `bodyschema predict`, `bodyschema status`; for several robots `bodyschema fleet list`.
    """
    # Before numpy is loaded: its threads would compete with each other and with the answers for the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from contextlib import nullcontext

    from bodyschema.cli.terminal.view_process import shown
    from bodyschema.daemon.learner.host import run_learners
    from bodyschema.daemon.service import logs
    from bodyschema.daemon.service.notify import Notifier
    from bodyschema.daemon.service.signals import SignalFlags, on_termination
    from bodyschema.fleet.hosting import configs_of, descriptions, spread
    from bodyschema.interfaces.clock import SystemClock
    from bodyschema.interfaces.extras import require_extra

    files = descriptions(robot or (Path(os.environ.get(VARIABLE, HERE)),))
    if view:
        require_extra("view", "the page")
    logs.set_up(verbose=verbose)
    configs = configs_of(files, state_dir)
    if min(processes, len(files)) > 1:
        spread(configs, processes, ["--verbose"] if verbose else [])
        return
    notifier, wishes = Notifier.of_environment(), SignalFlags()
    # In a terminal SIGHUP means that the terminal was closed.
    reload = wishes.reload if notifier.is_heard else None
    with shown(files[0]) if view else nullcontext(), on_termination(wishes.end, reload=reload):
        run_learners(configs, SystemClock(), wishes, notifier)
