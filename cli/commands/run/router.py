"""`bodyschema router`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bodyschema.cli.commands.options import flag
from bodyschema.daemon.service.signals import SignalFlags, on_termination
from bodyschema.interfaces.clock import SystemClock


def router(
    file: Annotated[Path, Parameter(help="Who may connect, and do what.")] = Path("router.toml"),
    /,
    *,
    zenohd: Annotated[bool, flag("Print the configuration for zenoh's own zenohd, and end.")] = False,
    verbose: Annotated[bool, flag("Log more.")] = False,
) -> None:
    """Run the zenoh router that connects several machines, with TLS and roles for sampler, learner and viewers.

    Ends with SIGTERM or Ctrl-C. docs/security.md describes how to create certificates; deploy/ has example files;
    `bodyschema install router` runs it as a systemd service.

    Needs: router.toml, and the certificates that it names.

    Next: `router` and `[zenoh.tls]` in each machine's robot.toml; `bodyschema doctor` there.
    """
    from bodyschema.cli.install.router import RouterConfig, run_router
    from bodyschema.daemon.service import logs
    from bodyschema.daemon.service.notify import Notifier

    config = RouterConfig.load(file)
    if zenohd:
        print(config.as_zenohd())  # noqa: T201
        return
    logs.set_up(verbose=verbose)
    signals = SignalFlags()
    with on_termination(signals.end):
        run_router(config, lambda: signals.ending, Notifier.of_environment(), SystemClock())
