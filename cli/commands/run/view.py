"""`bodyschema view`."""

from __future__ import annotations

import logging
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import HERE, RobotFile, flag, say
from bodyschema.daemon.service.signals import with_parent
from bodyschema.interfaces.extras import require_extra
from bodyschema.interfaces.interpreter import end, module_command
from bodyschema.interfaces.waits import Waits

log = logging.getLogger(__name__)

PORT = 8420


@contextmanager
def shown(robot_file: Path, port: int = PORT) -> Iterator[subprocess.Popen[bytes]]:
    """Run the page as a separate process until the end of the with statement.

    The page is not essential: if its port is taken, this is only logged.
    """
    command = module_command("bodyschema", "view", "--robot", str(robot_file), "--port", str(port))
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=os.environ | with_parent(), process_group=0)
    try:
        yield process
    finally:
        code = end(process, Waits.end_limit_s)
        if code > 0:
            log.warning("the page had ended with exit code %d; its message is above", code)


def view(
    *,
    robot: RobotFile = HERE,
    port: Annotated[
        int, Parameter(help="For the browser on this machine; 0: a free one.", validator=Number(gte=0, lte=65535))
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
