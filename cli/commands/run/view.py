"""`bodyschema view`."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import HERE, RobotFile, flag, say
from bodyschema.cli.terminal.view_process import PORT
from bodyschema.interfaces.extras import require_extra


def view(
    *,
    robot: RobotFile = HERE,
    port: Annotated[
        int,
        Parameter(help="For the browser on this machine; 0: a free one.", validator=Number(gte=0, lte=65535)),
    ] = PORT,
    verbose: Annotated[bool, flag("Log more.")] = False,
) -> None:
    """Serve a page for a browser on this machine: error over time, where to move next, residuals, segments, buttons.

    It reads everything over zenoh, so it can run on any machine that reaches both processes, and they may come and go.
    Only this machine can open the page (docs/view.md describes access from another). Ends with SIGTERM or Ctrl-C.

    Needs: the extra `view` (`pip install 'bodyschema[view]'`), robot.toml, and running processes: `bodyschema run`.

    Next: open the address in a browser.
    """
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.service import logs

    require_extra("view", "the page")
    from bodyschema.dashboard.server import serve

    logs.set_up(verbose=verbose)
    serve(Config.load(robot), port, lambda address: say(f"look at {address}"))
