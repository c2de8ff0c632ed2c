"""Processes of `bodyschema` as forks of one that has imported everything: a start costs 0.05 s of CPU, not 1 s.

All that makes a process is as ever: its own memory, files, signals, exit code. Tests of the start itself (imports, what
libraries read from the environment, LD_PRELOAD) need `subprocess`.
"""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import functools
import gc
import importlib
import json
import os
import pkgutil
import runpy
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import IO, Any

RARELY_NEEDED = (
    "bodyschema.dashboard",
    "bodyschema.fleet",
    "bodyschema.reproduce",
    "bodyschema.recordings.rerun_export",
    "bodyschema.__main__",
)
PR_SET_PDEATHSIG = 1
LONGEST_REQUEST = 1 << 17
MOST_FILES = 16
SHARED = "BODYSCHEMA_FORKING"  # where the forking process listens
_ASKING = threading.Lock()


class Child:
    """A process with the methods of `subprocess.Popen`.

    Args:
        arguments: as for the interpreter: `-m MODULE ...`, or a script and its arguments.
        stdout, stderr: open files; without them, the output is dropped.
        pass_fds: files that stay open in it, by their numbers there.
    """

    stdin: IO[bytes] | None = None
    stdout: IO[bytes] | None = None

    def __init__(
        self,
        *arguments: object,
        cwd: Path | None = None,
        env: Mapping[str, str] | None = None,
        stdout: IO | None = None,
        stderr: IO | None = None,
        pass_fds: Mapping[int, int] = MappingProxyType({}),
    ) -> None:
        self.args, self.returncode, self._lock = [str(word) for word in arguments], None, threading.Lock()
        self._heard = b""
        environment = dict(os.environ if env is None else env)
        request = json.dumps([self.args, str(cwd or Path.cwd()), environment, [1, 2, *pass_fds]])
        self._fate, fate = os.pipe()
        with open(os.devnull, "wb") as nowhere:
            files = [fate, (stdout or nowhere).fileno(), (stderr or nowhere).fileno(), *pass_fds.values()]
            with _ASKING:  # two threads must not start two servers
                socket.send_fds(_server(), [request.encode()], files)
        os.close(fate)
        self.pid = self._next()

    def __del__(self) -> None:
        os.close(self._fate)

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is not None:  # the server may not have closed its end yet
            return self.returncode
        if not (self._heard or select.select([self._fate], [], [], timeout)[0]):
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        with self._lock:  # two threads may wait
            if self.returncode is None:
                self.returncode = self._next()
            return self.returncode

    def _next(self) -> int:
        """Return the next number that the server says: the process's, then its exit code, which may come at once."""
        while b"\n" not in self._heard:
            if not (heard := os.read(self._fate, 64)):
                raise ChildProcessError("the forking process ended")
            self._heard += heard
        number, _, self._heard = self._heard.partition(b"\n")
        return int(number)

    def poll(self) -> int | None:
        with suppress(subprocess.TimeoutExpired):
            return self.wait(0.0)
        return None

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def run(
    *arguments: object, cwd: Path | None = None, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run it to its end, as `subprocess.run` does with the output captured as text."""
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        child = Child(*arguments, cwd=cwd, env=env, stdout=out, stderr=err)
        try:
            code = child.wait()
        finally:
            child.kill()
        for file in (out, err):
            file.seek(0)
        return subprocess.CompletedProcess(child.args, code, out.read(), err.read())


class _AsForks(ModuleType):
    """`subprocess` to modules of ours whose child processes may be forks, too."""

    def __getattr__(self, name: str) -> object:
        return getattr(subprocess, name)

    @staticmethod
    def Popen(command: list[str], *, pass_fds: tuple[int, ...] = (), **told: Any) -> Child | subprocess.Popen[bytes]:
        if command[1:3] != ["-P", "-m"]:  # a program that a test put in its place
            return subprocess.Popen(command, pass_fds=pass_fds, **told)
        passed = {file: file for file in pass_fds}
        if told["stdin"] != subprocess.PIPE:
            return Child(*command[2:], env=told["env"], stderr=sys.__stderr__, pass_fds=passed)
        (its_in, ours_out), (ours_in, its_out) = os.pipe(), os.pipe()
        with os.fdopen(its_out, "wb") as out, os.fdopen(its_in, "rb"):
            child = Child(
                *command[2:], env=told["env"], stdout=out, stderr=sys.__stderr__, pass_fds=passed | {0: its_in}
            )
        child.stdin, child.stdout = os.fdopen(ours_out, "wb"), os.fdopen(ours_in, "rb")
        return child


def fork_solvers_and_renderers() -> None:
    """Let solvers and renderers of this process be forks."""
    for module in ("bodyschema.daemon.learner.solver_process", "bodyschema.sim_backend.rendering.render_client"):
        with suppress(ImportError):  # of an extra that is not installed
            vars(importlib.import_module(module))["subprocess"] = _AsForks("subprocess")


@functools.cache
def _server() -> socket.socket:
    """Return the socket to the forking process: the one that started pytest's workers, or one of this process's own."""
    if SHARED not in os.environ:
        return start()
    ours = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    atexit.register(ours.close)
    ours.connect(bytes.fromhex(os.environ[SHARED]))
    return ours


def start() -> socket.socket:
    """Start the forking process, which ends with this one; later child processes of this one find it, too."""
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    environment = {"OPENBLAS_NUM_THREADS": "1"} | os.environ
    with its, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as others:
        others.bind("")  # to a name that is not in use
        others.listen()
        files = [its.fileno(), others.fileno()]
        server = subprocess.Popen(
            [sys.executable, __file__, *map(str, files)], stdin=subprocess.DEVNULL, env=environment, pass_fds=files
        )
        atexit.register(server.wait)  # its time of the processor counts
        os.environ[SHARED] = others.getsockname().hex()
    atexit.register(ours.close)
    return ours


def _import_all() -> None:
    import bodyschema

    for module in pkgutil.walk_packages(bodyschema.__path__, "bodyschema."):
        if not module.name.startswith(RARELY_NEEDED):
            with suppress(ImportError):  # of an extra that is not installed
                importlib.import_module(module.name)


def _serve(wire: socket.socket, others: socket.socket) -> list[str]:
    """Fork for each request, until the other end of `wire` closes; return in the fork the program to run."""
    alive: dict[int, tuple[int, int]] = {}  # pidfd: pid, where its exit code goes
    asking = {wire.fileno(): wire}
    while True:
        for ready in select.select([others.fileno(), *asking, *alive], [], [])[0]:
            if ready == others.fileno():
                one = others.accept()[0]
                _, user, _ = struct.unpack("3i", one.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
                if user == os.getuid():  # anybody on the machine may connect
                    asking[one.fileno()] = one
                continue
            if ready in alive:
                pid, fate = alive.pop(ready)
                with suppress(BrokenPipeError):  # of a worker that is gone
                    os.write(fate, b"%d\n" % os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
                os.close(fate)
                os.close(ready)
                continue
            message, files, *_ = socket.recv_fds(asking[ready], LONGEST_REQUEST, MOST_FILES)
            if not message:
                if ready == wire.fileno():
                    os._exit(0)
                asking.pop(ready).close()
                continue
            if (pid := os.fork()) == 0:
                for one in (others, *asking.values()):  # else they close, when they are collected, what is there then
                    one.detach()
                return _settle(json.loads(message), files)
            os.write(files[0], b"%d\n" % pid)
            alive[os.pidfd_open(pid)] = pid, files[0]
            for file in files[1:]:
                os.close(file)


def _settle(request: tuple[list[str], str, dict[str, str], list[int]], files: list[int]) -> list[str]:
    """Reset the process to the state of a new one; return its arguments."""
    arguments, folder, environment, places = request
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    above = max(map(int, os.listdir("/proc/self/fd"))) + max(places) + 1  # of all that is open or is going to be
    copies = [fcntl.fcntl(file, fcntl.F_DUPFD, above) for file in files[1:]]
    os.closerange(3, above)
    for copy, place in zip(copies, places, strict=True):
        os.dup2(copy, place)
        os.close(copy)
    # Those of the server know whether its own files can seek, not whether these can.
    sys.stdout = sys.__stdout__ = os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.__stderr__ = os.fdopen(2, "w", 1, errors="backslashreplace", closefd=False)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    return arguments


def _run(arguments: list[str]) -> int:
    """Run them; return the exit code that Python would end with."""
    sys.argv[:] = arguments[1:] if arguments[0] == "-m" else arguments
    try:
        if arguments[0] == "-m":
            sys.path.insert(0, os.getcwd())
            sys.modules.pop(arguments[1], None)
            runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
        else:
            sys.path.insert(0, os.path.dirname(arguments[0]))
            runpy.run_path(arguments[0], run_name="__main__")
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    sys.path.pop(0)
    _import_all()
    fork_solvers_and_renderers()
    gc.freeze()  # a collection would copy every page
    code = _run(_serve(*(socket.socket(fileno=int(file)) for file in sys.argv[1:])))
    threading._shutdown()
    atexit._run_exitfuncs()
    for stream in (sys.stderr, sys.stdout):
        stream.flush()
    os._exit(code)  # taking all modules apart costs more than all the rest
