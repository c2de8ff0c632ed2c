"""Run the solver in a separate process.

One solve takes tenths of a second inside LAPACK, which holds the interpreter's lock; in a thread it would delay answers
by that time. The child is a batch process, uses a processor at most half of the time, and ends with its parent.

Both directions carry frames: four bytes of length, then a MessagePack message.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import struct
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import fields, replace
from typing import IO, Any, Self

import msgspec
import numpy as np

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.interpreter import end, module_command
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.waits import Waits
from bodyschema.learning.solvers.orientation import OrientationSolution
from bodyschema.learning.solvers.solver import DirectSolver, Solved, Task
from kbmaps import ChainBelief, ChainTolerances, KBMap, OrientedChain, ResidualModel


class _Settings:
    longest_rest_s: float = 5.0  # after a solution, which is followed by a rest as long as it took
    # A child that owes an answer and uses no processor for this long is stopped or locked up: the learner's
    # `WatchdogSec`.
    hung_after_s: float = 60.0
    reads_within_s: float = 0.1  # a child that waits for orders takes some of them within this time


_LENGTH = struct.Struct("<I")


class SolverLostError(BodyschemaError):
    """The solver's process has ended; `start` starts a new one."""


class Start(msgspec.Struct, frozen=True, tag="start"):
    """Discard all pairs and start a task, given by its fields."""

    task: dict[str, Any]
    robot: int = 0


class Learn(msgspec.Struct, frozen=True, tag="learn"):
    """Pairs: q (n, joints), x (n, 3), cov (n, 3, 3) and orientations (n, 4) as little-endian float64."""

    joints: int
    q: bytes
    x: bytes
    cov: bytes | None = None
    turns: bytes | None = None
    robot: int = 0


class Solve(msgspec.Struct, frozen=True, tag="solve"):
    """Request a solution for all pairs so far."""

    robot: int = 0


# A model travels as an extension of MessagePack, whose code is its place here.
_MODELS = (KBMap, ChainBelief, ResidualModel, OrientedChain)


def _fields(record: Task | Solved | OrientationSolution | ChainTolerances) -> dict[str, Any]:
    """Return a record in MessagePack's form."""
    return {field.name: _packed(getattr(record, field.name)) for field in fields(record)}


def _packed(value: object) -> object:
    for code, kind in enumerate(_MODELS):
        if isinstance(value, kind):
            return msgspec.msgpack.Ext(code, value.to_bytes())
    return _fields(value) if isinstance(value, OrientationSolution | ChainTolerances) else value


def _unpacked(code: int, data: memoryview) -> object:
    return _MODELS[code].from_bytes(bytes(data))


_orders = msgspec.msgpack.Decoder(Start | Learn | Solve, ext_hook=_unpacked)
_solutions = msgspec.msgpack.Decoder(dict[str, Any], ext_hook=_unpacked)


class SolverProcess:
    """A `Solver` in a child process, started with the first task. Use as a context manager.

    It may hold the pairs of several robots, by their numbers, and solves for one at a time.

    All methods but `__exit__` raise SolverLostError when the child has died.
    """

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None
        self._received, self._unsent = bytearray(), bytearray()
        self._unanswered = False
        self._last_progress_s, self._checked_at = (
            0.0,
            0.0,
        )  # the child's processor time at the last look, and when that was

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    @property
    def pid(self) -> int | None:
        """Process id of the child; None before the first task."""
        return self._child.pid if self._child is not None else None

    def start(self, task: Task, robot: int = 0) -> None:
        """Discard all pairs and start a new task."""
        if self._child is None:
            command = module_command("bodyschema.daemon.learner.solver_process")
            environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
            # A process group of its own: Ctrl-C in a terminal is handled by the parent.
            try:
                self._child = subprocess.Popen(
                    command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, process_group=0
                )
            except OSError as error:  # out of memory, or too many open files
                raise SolverLostError(f"the solver cannot be started: {error.strerror}; it is tried again") from error
            if self._child.stdin is not None:
                os.set_blocking(self._child.stdin.fileno(), False)
        self._send(Start(_fields(task), robot))

    def learn(
        self,
        q: FloatArray,
        x: FloatArray,
        cov: FloatArray | None = None,
        turns: FloatArray | None = None,
        robot: int = 0,
    ) -> None:
        """Send more pairs, as in `Solver`."""
        parts = [None if each is None else each.astype("<f8").tobytes() for each in (cov, turns)]
        self._send(Learn(q.shape[1], q.astype("<f8").tobytes(), x.astype("<f8").tobytes(), *parts, robot=robot))

    def solve(self, robot: int = 0) -> None:
        """Request the solution for all pairs so far."""
        self._send(Solve(robot))
        self._unanswered, self._checked_at = True, time.monotonic()

    def poll(self) -> Solved | None:
        """Return the next solution that has arrived, without waiting."""
        child = self._child
        if child is None or child.stdout is None:
            return None
        self._flush(0.0)
        while select.select([child.stdout], [], [], 0)[0]:
            part = os.read(child.stdout.fileno(), 1 << 20)
            if not part:
                raise self._lost()
            self._received += part
        solved = self._next_solution()
        if solved is None and self._unanswered:
            self._require_progress(child.pid)
        elif solved is not None:
            self._unanswered = not solved.last
        return solved

    def _require_progress(self, pid: int) -> None:
        if time.monotonic() - self._checked_at < _Settings.hung_after_s:
            return
        try:
            used_s = time.clock_gettime(~pid << 3 | 2)  # as in clock_getcpuclockid(3)
        except OSError:  # it has ended, as the next look at its pipe shows, or this system has no such clock
            return
        if used_s == self._last_progress_s:
            os.kill(pid, signal.SIGKILL)
            self._end()
            raise SolverLostError(f"the solver did nothing for {_Settings.hung_after_s:.0f} s; it is started again")
        self._last_progress_s, self._checked_at = used_s, time.monotonic()

    def _next_solution(self) -> Solved | None:
        if len(self._received) < _LENGTH.size:
            return None
        end = _LENGTH.size + _LENGTH.unpack_from(self._received)[0]
        if len(self._received) < end:
            return None
        solved = _solutions.decode(bytes(self._received[_LENGTH.size : end]))
        del self._received[:end]
        if isinstance(solved["model"], ResidualModel):
            solved["belief"] = solved["model"]
        turned = solved.pop("orientation")
        return Solved(**solved, orientation=None if turned is None else OrientationSolution(**turned))

    def _send(self, order: Start | Learn | Solve) -> None:
        if self._child is None:
            raise SolverLostError("the solver has not been started")
        self._unsent += _framed(order)
        self._flush(_Settings.reads_within_s)

    def _flush(self, within_s: float) -> None:
        """Write what the child reads within this time each; `poll` writes the rest: a stopped child blocks nothing."""
        child = self._child
        if child is None or child.stdin is None:
            return
        try:
            while self._unsent and select.select([], [child.stdin], [], within_s)[1]:
                del self._unsent[: os.write(child.stdin.fileno(), self._unsent)]
        except OSError as error:
            raise self._lost() from error

    def _lost(self) -> SolverLostError:
        code = self._end()
        return SolverLostError(f"the solver's process ended with exit code {code}; it is started again")

    def _end(self) -> int | None:
        child, self._child, self._unanswered = self._child, None, False
        self._received.clear()
        self._unsent.clear()
        if child is None or child.stdin is None or child.stdout is None:
            return None
        child.stdin.close()
        try:
            return end(child, Waits.end_limit_s)
        finally:
            child.stdout.close()


def serve(orders: IO[bytes], solutions: IO[bytes]) -> None:
    """Carry out orders until they end; before another solve, rest for as long as the last one took."""
    solvers: defaultdict[int, DirectSolver] = defaultdict(DirectSolver)
    rested_at = 0.0
    while (order := _read(orders)) is not None:
        solver = solvers[order.robot]
        if isinstance(order, Start):
            tolerances = order.task.pop("tolerances")
            solver.start(Task(**order.task, tolerances=None if tolerances is None else ChainTolerances(**tolerances)))
            rested_at = 0.0  # a new task starts with few pairs, and its first result is urgent
        elif isinstance(order, Learn):
            solver.learn(
                np.frombuffer(order.q, dtype="<f8").reshape(-1, order.joints),
                np.frombuffer(order.x, dtype="<f8").reshape(-1, 3),
                None if order.cov is None else np.frombuffer(order.cov, dtype="<f8").reshape(-1, 3, 3),
                None if order.turns is None else np.frombuffer(order.turns, dtype="<f8").reshape(-1, 4),
            )
        else:
            time.sleep(max(rested_at - time.monotonic(), 0.0))
            rested_at = time.monotonic() + min(_solve(solver, solutions), _Settings.longest_rest_s)


def _solve(solver: DirectSolver, solutions: IO[bytes]) -> float:
    """Solve, and send each solution as it is found; return the processor time used [s]."""
    begin = time.process_time()  # on a busy machine most of the wall time is waiting, which is sufficient rest
    for solved in solver.solutions():
        # A chain with residual is its own belief: sent once, as reading one takes milliseconds.
        _write(solutions, _fields(replace(solved, belief=None) if solved.belief is solved.model else solved))
    return time.process_time() - begin


def _write(stream: IO[bytes], solved: dict[str, Any]) -> None:
    stream.write(_framed(solved))
    stream.flush()


def _framed(message: Start | Learn | Solve | dict[str, Any]) -> bytes:
    payload = msgspec.msgpack.encode(message)
    return _LENGTH.pack(len(payload)) + payload


def _read(stream: IO[bytes]) -> Start | Learn | Solve | None:
    """Return the next order; None if the parent has gone, even in the middle of one."""
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    length = _LENGTH.unpack(head)[0]
    payload = stream.read(length)
    return _orders.decode(payload) if len(payload) == length else None


if __name__ == "__main__":
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    try:
        serve(sys.stdin.buffer, sys.stdout.buffer)
    except BrokenPipeError:
        os._exit(0)  # the parent died while a solution was being sent; flushing at exit would only fail again
