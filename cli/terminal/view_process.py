"""Run the page as a separate process."""

from __future__ import annotations

import logging
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bodyschema.daemon.service.signals import with_parent
from bodyschema.interfaces.interpreter import module_command
from bodyschema.interfaces.waits import END_LIMIT_S

log = logging.getLogger(__name__)

PORT = 8420


@contextmanager
def shown(robot_file: Path, port: int = PORT) -> Iterator[subprocess.Popen[bytes]]:
    """Run the page as a separate process until the end of the with statement.

    The page is not essential: a port that is taken is only logged.
    """
    command = module_command("bodyschema", "view", "--robot", str(robot_file), "--port", str(port))
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=os.environ | with_parent(), process_group=0)
    try:
        yield process
    finally:
        process.terminate()
        try:
            code = process.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
        if code > 0:
            log.warning("the page had ended with exit code %d; its message is above", code)
