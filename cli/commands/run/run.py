"""`bodyschema run`."""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import HERE, VARIABLE, flag, several
from bodyschema.daemon.service.signals import SignalFlags, on_termination
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.extras import require_extra
from bodyschema.interfaces.interpreter import module_command


def run(
    process: Annotated[
        Literal["sampler", "learner"] | None, Parameter(help="One of the two in this terminal; else both.")
    ] = None,
    /,
    *,
    robot: Annotated[
        tuple[Path, ...],
        several(f"The robot's description, or for the learner a folder of them; else {VARIABLE} or robot.toml"),
    ] = (),
    sim: Annotated[bool, flag("The simulated robot in the place of the hardware.")] = False,
    state_dir: Annotated[
        Path | None,
        Parameter(
            help="Where samples and checkpoint live (a folder each for several robots); else as robot.toml says."
        ),
    ] = None,
    view: Annotated[bool, flag("Show the page of `bodyschema view` too, as a process of its own.")] = False,
    exit_at_end: Annotated[bool, flag("Sampler: end when a recording is through.")] = False,
    processes: Annotated[
        int, Parameter(help="Learner: spread the robots over this number of processes.", validator=Number(gte=1))
    ] = 1,
    verbose: Annotated[bool, flag("Log more.")] = False,
) -> None:
    """Start sampler and learner as separate processes, and restart one that dies. Ctrl-C ends both.

    `bodyschema run sampler` turns encoder readings and camera frames into samples, stores and publishes them. Each
    sample is stored before it is published. While the store cannot be written (the disk is full), the status reports
    it and no samples are taken.

    `bodyschema run learner` learns the kinematics and answers queries. New samples come from the sampler, on this
    machine or another; without one, the learner answers from the samples so far. With several robots, each sample is
    learnt as it arrives, and less urgent work is done in turns (docs/fleet.md).

    Needs: robot.toml (`bodyschema init`) with joints and cameras, or a recording in its table [drivers]; with --sim,
    the arm alone (`bodyschema init --sim` writes an example).

    Next: in another terminal, `bodyschema status --watch`, `bodyschema view` and `bodyschema predict`.
    """
    from bodyschema.daemon.service import logs

    misplaced = {
        "--sim": sim and process == "learner",
        "--view": view and process == "sampler",
        "--exit-at-end": exit_at_end and process != "sampler",
        "--processes": processes > 1 and process != "learner",
        "several --robot": len(robot) > 1 and process != "learner",
    }
    for option in (name for name, given in misplaced.items() if given):
        raise RequestError(f"{option} does not go with `bodyschema run{'' if process is None else f' {process}'}`")
    if view:
        require_extra("view", "the page")
    logs.set_up(verbose=verbose)
    files = robot or (Path(os.environ.get(VARIABLE, HERE)),)
    if process == "learner":
        _learner(files, state_dir, processes, view=view, verbose=verbose)
    elif process == "sampler":
        _sampler(files[0], state_dir, sim=sim, exit_at_end=exit_at_end)
    else:
        _both(files[0], state_dir, sim=sim, view=view, verbose=verbose)


def _both(robot: Path, state_dir: Path | None, *, sim: bool, view: bool, verbose: bool) -> None:
    from bodyschema.cli.commands.run.view import shown
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.service.supervise import Child, Supervisor
    from bodyschema.daemon.wiring.wiring import check_sources

    config = Config.load(robot)
    config.require_learnable()
    check_sources(config, sim=sim)
    options = ["--robot", str(robot), *(["--state-dir", str(state_dir)] if state_dir else [])]
    options += ["--verbose"] if verbose else []
    sampler = Child("sampler", module_command("bodyschema", "run", "sampler", *options, *(["--sim"] if sim else [])))
    learner = Child("learner", module_command("bodyschema", "run", "learner", *options))
    supervisor = Supervisor([sampler, learner])
    with shown(robot) if view else nullcontext(), on_termination(supervisor.stop):
        supervisor.run()


def _sampler(robot: Path, state_dir: Path | None, *, sim: bool, exit_at_end: bool) -> None:
    from bodyschema.cli.install.units import devices_of
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.sampler.devices import session_of
    from bodyschema.daemon.sampler.sampler import LOOPS, Sampler
    from bodyschema.daemon.service.notify import Notifier
    from bodyschema.daemon.service.service import Service
    from bodyschema.daemon.transport.session import ZenohSession
    from bodyschema.daemon.wiring.wiring import open_sources
    from bodyschema.recordings.store.store import PairStore

    notifier = Notifier.of_environment()
    config = Config.load(robot)
    if state_dir is not None:
        config = config.with_state_dir(state_dir)
    with (  # the store comes last, so that an earlier failure leaves no trace
        open_sources(config, sim=sim) as sources,
        ZenohSession(listen=config.tables.zenoh.sampler, settings=config.zenoh_settings("sampler")) as bus,
        PairStore(config.store_file, session_of(config, SystemClock()), working=notifier.starting) as store,
    ):
        service = Service(notifier, LOOPS, SystemClock(), devices=devices_of(config))
        process = Sampler(config, sources, bus, store, exit_at_end=exit_at_end, service=service)
        # In a terminal SIGHUP means that the terminal was closed.
        with on_termination(process.stop, reload=process.reload if notifier.is_connected else None):
            process.run()


def _learner(robots: tuple[Path, ...], state_dir: Path | None, processes: int, *, view: bool, verbose: bool) -> None:
    from bodyschema.cli.commands.run.view import shown
    from bodyschema.daemon.learner.host import run_learners
    from bodyschema.daemon.service.notify import Notifier
    from bodyschema.fleet.hosting import configs_of, descriptions, spread

    files = descriptions(robots)
    configs = configs_of(files, state_dir)
    if min(processes, len(files)) > 1:
        spread(configs, processes, ["--verbose"] if verbose else [])
        return
    notifier, flags = Notifier.of_environment(), SignalFlags()
    # In a terminal SIGHUP means that the terminal was closed.
    reload = flags.reload if notifier.is_connected else None
    with shown(files[0]) if view else nullcontext(), on_termination(flags.end, reload=reload):
        run_learners(configs, SystemClock(), flags, notifier)
