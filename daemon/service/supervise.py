"""Restart child processes when they die."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import time
from collections.abc import Sequence

from bodyschema.daemon.service.signals import SERVING, with_parent
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.waits import Waits

log = logging.getLogger(__name__)

END_LIMIT_S = 10.0


class Child:
    """A process that is kept running.

    If a process refuses to start (it ends with its own error code before it has reported that it works), a person is
    needed, and this is an error. A process that was killed, or ends later, is restarted. The waits grow until it runs
    for longer than their limit.
    """

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self.name = name
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None
        self._has_served = False
        self._pipe = -1
        self._started_at = 0.0
        self._start_at = 0.0
        self._wait_s = Waits.first_s

    def ensure_running(self) -> None:
        """Start the process if it is not running and its waiting time is over.

        Raises:
            BodyschemaError: it refused to start.
        """
        now = time.monotonic()
        if self._process is None:
            if now >= self._start_at:
                self._process, self._pipe = self._start()
                self._started_at = now
            return
        if now - self._started_at > Waits.longest_s:
            self._wait_s = Waits.first_s
        code = self._process.poll()
        if code is not None:
            self._has_served = self._has_served or _has_line(self._pipe)
            self._forget()
            self._handle_exit(code, now)

    def end(self) -> None:
        """Request the end of the process."""
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)

    def join(self, deadline: float) -> None:
        """Wait for the end of the process until `deadline` on the monotonic clock [s], then kill it."""
        if self._process is None:
            return
        try:
            self._process.wait(max(deadline - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            log.error("the %s did not end in %g s and was killed", self.name, END_LIMIT_S)
            self._process.kill()
            self._process.wait()
        self._forget()

    def _start(self) -> tuple[subprocess.Popen[bytes], int]:
        """Start the process; return it, and the pipe in which it reports that it works."""
        reading, writing = os.pipe()
        os.set_blocking(reading, False)
        environment = os.environ | with_parent() | {SERVING: str(writing)}
        try:
            process = subprocess.Popen(self._command, stdin=subprocess.DEVNULL, env=environment, pass_fds=[writing])
        finally:
            os.close(writing)
        return process, reading

    def _forget(self) -> None:
        os.close(self._pipe)
        self._process = None

    def _handle_exit(self, code: int, now: float) -> None:
        if code > 0 and not self._has_served:
            raise BodyschemaError(f"the {self.name} could not start (exit code {code}); its message is above")
        cause = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        log.error("the %s %s; starting it again in %g s", self.name, cause, self._wait_s)
        self._start_at = now + self._wait_s
        self._wait_s = min(2 * self._wait_s, Waits.longest_s)


def _has_line(pipe: int) -> bool:
    try:
        return bool(os.read(pipe, 1))
    except BlockingIOError:  # a child of the process keeps it open
        return False


class Supervisor:
    """Supervisor that keeps child processes running until `stop`, and ends them all."""

    def __init__(self, children: Sequence[Child]) -> None:
        self._children = children
        self._stopping = False

    def stop(self) -> None:
        """Request the end of `run`. Only sets a flag: a signal handler may call it."""
        self._stopping = True

    def run(self) -> None:
        """Keep the children running until `stop`.

        Raises:
            BodyschemaError: one of them refused to start; the others were ended.
        """
        try:
            while not self._stopping:
                for child in self._children:
                    child.ensure_running()
                time.sleep(Waits.poll_s)
        finally:
            for child in self._children:
                child.end()
            deadline = time.monotonic() + END_LIMIT_S
            for child in self._children:
                child.join(deadline)
