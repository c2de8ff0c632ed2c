"""The low-priority work of one or several learners in one thread, in turns and within a share of a processor."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Sequence
from typing import Protocol

from bodyschema.daemon.service import Service
from bodyschema.daemon.solver_process import SolverLostError
from bodyschema.interfaces.protocols import Clock

log = logging.getLogger(__name__)

IDLE_S = 0.02
SOLVE_WHEN_IDLE_S = 0.5
RESTART_S = 1.0
NICENESS = 10
# Whoever waits for a lock gets it between two pieces.
BREATH_S = 1e-4


class Worker(Protocol):
    """Whose work it is."""

    def work(self) -> bool:
        """One small piece of it; False when there is none. SolverLostError: the solver has lost its pairs."""
        ...

    def restart_solver(self) -> None:
        """Give the solver its pairs again."""
        ...

    def solve_soon(self) -> None:
        """Nothing was left to do for a while."""
        ...


class Background:
    """Works for all until `stop` is set; a piece for each in turn, so that none waits for another's backlog.

    Args:
        share: of one processor's time, at most; 1 sets no limit.
    """

    def __init__(
        self, workers: Sequence[Worker], service: Service, clock: Clock, stop: threading.Event, *, share: float = 1.0
    ) -> None:
        self._workers, self._service, self._clock, self._stop = workers, service, clock, stop
        self._rest = 1.0 / share - 1.0
        self._idle_since = [clock.now()] * len(workers)

    def run(self) -> None:
        """Work, at low priority; within a share of a processor at the usual one.

        On a busy machine a thread of low priority may be kept waiting while it holds Python's interpreter, and all
        others of its process wait with it.
        """
        if self._rest == 0.0:
            with contextlib.suppress(OSError):  # niceness is a courtesy: without it answers are a little later
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
        while not self._stop.is_set():
            self._service.beat("background")
            begin = time.thread_time()
            try:
                worked = self._round()
            except SolverLostError as error:
                log.warning("%s", error)
                for worker in self._workers:
                    worker.restart_solver()
                self._stop.wait(RESTART_S)
                continue
            if worked:
                self._stop.wait(max(self._rest * (time.thread_time() - begin), BREATH_S))
            elif not self._stop.wait(IDLE_S):
                self._solve_what_rests()

    def _round(self) -> bool:
        """A piece for each; whether there was any."""
        worked = [worker.work() for worker in self._workers]
        for place, busy in enumerate(worked):
            if busy:
                self._idle_since[place] = self._clock.now()
        return any(worked)

    def _solve_what_rests(self) -> None:
        now = self._clock.now()
        for worker, since in zip(self._workers, self._idle_since, strict=True):
            if now - since > SOLVE_WHEN_IDLE_S:
                worker.solve_soon()
