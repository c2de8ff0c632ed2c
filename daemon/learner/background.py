"""Low-priority work of one or several learners in one thread, in turns and within a share of a processor."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Sequence
from typing import Protocol

from bodyschema.daemon.learner.solver_process import SolverLostError
from bodyschema.daemon.service.service import Service
from bodyschema.interfaces.protocols import Clock

log = logging.getLogger(__name__)

IDLE_S = 0.02
SOLVE_WHEN_IDLE_S = 0.5
RESTART_S = 1.0
NICENESS = 10
# A thread that waits for a lock gets it between two pieces of work.
BREATH_S = 1e-4


class Worker(Protocol):
    """Source of the background work."""

    def work(self) -> bool:
        """Do one small piece of work; return False if there is none. SolverLostError: the solver has lost its pairs."""
        ...

    def restart_solver(self) -> None:
        """Send the solver its pairs again."""
        ...

    def solve_soon(self) -> None:
        """Request a solution: there has been no other work for a while."""
        ...


class Background:
    """Work for all until `stop` is set, one piece for each in turn, so that none waits for another's backlog.

    Args:
        share: share of one processor's time, at most; 1 sets no limit.
    """

    def __init__(
        self, workers: Sequence[Worker], service: Service, clock: Clock, stop: threading.Event, *, share: float = 1.0
    ) -> None:
        self._workers, self._service, self._clock, self._stop = workers, service, clock, stop
        self._rest = 1.0 / share - 1.0
        self._idle_since = [clock.now()] * len(workers)

    def run(self) -> None:
        """Run the work: at low priority, or at normal priority within a share of a processor.

        On a busy machine a low-priority thread may be preempted while it holds Python's interpreter lock, and all other
        threads of the process then wait with it.
        """
        if self._rest == 0.0:
            with contextlib.suppress(OSError):  # niceness is optional: without it answers are slightly later
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
        """Do one piece for each; return True if there was any."""
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
