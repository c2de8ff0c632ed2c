"""Sampler and learner as the two processes of a live system, on free ports, fed with a recording."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bodyschema.daemon.service.signals import with_parent
from bodyschema.daemon.transport.session import is_alive
from bodyschema.interfaces.errors import BusError
from bodyschema.interfaces.interpreter import end, module_command


class ProcessSettings:
    start_limit_s: float = 300.0  # a full machine takes minutes to import; a process that ends is reported at once
    end_limit_s: float = 15.0  # after which a process is killed


@dataclass(frozen=True, slots=True)
class Process:
    """One of the two processes; its output goes into `log`."""

    name: str
    log: Path
    popen: subprocess.Popen[bytes]

    def check(self) -> None:
        """Raise BusError with its last output if it has ended."""
        code = self.popen.poll()
        if code is None:
            return
        lines = self.log.read_text(errors="replace").strip().splitlines() or ["it said nothing"]
        raise BusError(f"the {self.name} ended with exit code {code}: {lines[-1].removeprefix('bodyschema: ')}")

    def wait_for(self, endpoint: str, token: str) -> None:
        """Return as soon as it is alive on `endpoint`; raise BusError if it ends before, or takes too long.

        Listening is not enough: it is alive when it answers.
        """
        limit = time.monotonic() + ProcessSettings.start_limit_s
        while not is_alive(endpoint, token):
            self.check()
            if time.monotonic() > limit:
                waited = f"{ProcessSettings.start_limit_s:.0f} s"
                raise BusError(f"the {self.name} does not answer after {waited}; {self.log} may say why")
            time.sleep(0.1)


@contextmanager
def started(name: str, arguments: list[str], environment: Mapping[str, str], log: Path) -> Iterator[Process]:
    """Run `bodyschema run ARGUMENTS` for the duration of the with statement."""
    with log.open("wb") as stream:
        # In a process group of its own: the parent handles Ctrl-C in a terminal.
        popen = subprocess.Popen(
            module_command("bodyschema", "run", *arguments),
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            env=os.environ | environment | with_parent(),
            process_group=0,
        )
        try:
            yield Process(name, log, popen)
        finally:
            end(popen, ProcessSettings.end_limit_s)


def override(table: str, key: str, value: object) -> dict[str, str]:
    """Return one key of robot.toml as an environment variable, which overrides the file."""
    return {f"BODYSCHEMA_{table}_{key}".upper(): json.dumps(value)}


def free_endpoint() -> str:
    """Return an unused endpoint on the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
