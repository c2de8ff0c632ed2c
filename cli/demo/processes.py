"""The processes of the demo: the daemon as `bodyschema run` starts it, and a client that asks for predictions."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

from bodyschema.daemon.service.signals import with_parent
from bodyschema.daemon.transport.bus import is_alive
from bodyschema.interfaces.errors import BusError
from bodyschema.interfaces.interpreter import module_command

from .scene import Scene

START_LIMIT_S = 60.0
END_LIMIT_S = 15.0


class Daemon:
    """`bodyschema run --sim` with its output in the scene's log."""

    def __init__(self, process: subprocess.Popen[bytes], scene: Scene) -> None:
        self._process, self._scene = process, scene

    def check(self) -> None:
        """Raise BusError if it has ended."""
        if self._process.poll() is not None:
            raise BusError(
                f"the daemon ended with exit code {self._process.returncode}; {self._scene.log_file} says why"
            )

    def wait_for(self, endpoint: str, alive: str) -> None:
        """Return once the process that listens on `endpoint` is alive. BusError if it is not alive in time."""
        limit = time.monotonic() + START_LIMIT_S
        while not is_alive(endpoint, alive):
            self.check()
            if time.monotonic() > limit:
                raise BusError(
                    f"nothing runs on {endpoint} after {START_LIMIT_S:.0f} s; {self._scene.log_file} says why"
                )
            time.sleep(0.1)


@contextmanager
def started_daemon(scene: Scene) -> Iterator[Daemon]:
    """Run sampler and learner until the end of the with statement."""
    command = module_command("bodyschema", "run", "--sim", "--robot", str(scene.robot_file))
    with scene.log_file.open("wb") as log:
        environment = os.environ | with_parent()
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)
        try:
            yield Daemon(process, scene)
        finally:
            _end(process)


class Asker:
    """Output of the asking process."""

    def __init__(self, lines: queue.SimpleQueue[bytes]) -> None:
        self._lines = lines
        self.answers = 0
        self.unanswered = 0
        self.p50_ms = 0.0
        self.worst_ms = 0.0

    def update(self) -> None:
        """Read its output since the last call."""
        while not self._lines.empty():
            said = json.loads(self._lines.get())
            self.answers += said["answers"]
            self.unanswered += said["unanswered"] + said["refused"]
            self.p50_ms, self.worst_ms = said["p50_ms"], said["worst_ms"]


@contextmanager
def started_asker(scene: Scene, seed: int) -> Iterator[Asker]:
    """Run a process that asks for predictions until the end of the with statement."""
    command = module_command("bodyschema.cli.demo.asker", str(scene.robot_file), str(seed))
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    reader = threading.Thread(target=_collect, args=(process.stdout, lines), name="asker's lines")
    reader.start()
    try:
        yield Asker(lines)
    finally:
        _end(process)
        reader.join()
        process.stdout.close()


def _collect(stream: IO[bytes], lines: queue.SimpleQueue[bytes]) -> None:
    for line in stream:
        lines.put(line)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(END_LIMIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
