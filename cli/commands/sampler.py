"""`bodyschema sampler`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bodyschema.cli.commands.options import HERE, RobotFile, flag


def sampler(
    *,
    robot: RobotFile = HERE,
    sim: Annotated[bool, flag("The simulated robot in the place of the hardware.")] = False,
    state_dir: Annotated[Path | None, Parameter(help="Where the store lives; else as robot.toml says.")] = None,
    exit_at_end: Annotated[bool, flag("End when a recording is through.")] = False,
    verbose: Annotated[bool, flag("Log more.")] = False,
) -> None:
    """Turn encoder readings and camera frames into pairs, store and publish them. Ends with SIGTERM or Ctrl-C.

    Each pair is stored before it is published. While the store cannot be written (the disk is full), the status reports
    it and no pairs are taken.

    Needs: robot.toml (`bodyschema init`) with joints and cameras or a recording; or --sim.

    Next: `bodyschema learner`, `bodyschema status --watch`.
    """
    from bodyschema.cli.install.units import devices_of
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.sampler.sampler import LOOPS, Sampler
    from bodyschema.daemon.sampler.session import session_of
    from bodyschema.daemon.service import logs
    from bodyschema.daemon.service.notify import Notifier
    from bodyschema.daemon.service.service import Service
    from bodyschema.daemon.service.signals import on_termination
    from bodyschema.daemon.transport.bus import ZenohSession
    from bodyschema.daemon.wiring.wiring import open_sources
    from bodyschema.interfaces.clock import SystemClock
    from bodyschema.recordings.store.store import PairStore

    logs.set_up(verbose=verbose)
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
        with on_termination(process.stop, reload=process.reload if notifier.is_heard else None):
            process.run()
