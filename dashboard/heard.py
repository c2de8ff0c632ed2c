"""Last status received from one of the processes."""

from __future__ import annotations

import threading
from typing import Any, Generic, TypeVar

from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import decode
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.protocols import Clock

from .documents import ProcessDocument

# A process publishes its status every second; less often on a busy machine.
SILENT_AFTER_S = 5.0

S = TypeVar("S", SamplerStatus, LearnerStatus)


class Heard(Generic[S]):
    """Newest status of one process; any thread may use it."""

    def __init__(self, kind: type[S], endpoint: str, clock: Clock) -> None:
        self._kind, self._endpoint, self._clock = kind, endpoint, clock
        self._lock = threading.Lock()
        self._alive = False
        self._heard_at: float | None = None
        self._heard_utc: float | None = None
        self._status: S | None = None
        self._fields: dict[str, Any] | None = None
        self._problem: str | None = None

    @property
    def status(self) -> S | None:
        """Last status, even if the process has gone."""
        with self._lock:
            return self._status

    @property
    def answers(self) -> bool:
        """True if the process is alive now."""
        with self._lock:
            return self._is_there()

    def take(self, payload: bytes, utc: float) -> None:
        """Take a published status, received at this time [s since 1970]."""
        try:
            status, fields, problem = decode(payload, self._kind), decode(payload, dict[str, Any]), None
        except RequestError as error:
            status, fields, problem = None, None, f"{error}. Is it of another version?"
        with self._lock:
            self._heard_at, self._heard_utc, self._problem = self._clock.now(), utc, problem
            if status is not None:
                self._status, self._fields = status, fields

    def note_alive(self, alive: bool) -> None:
        """Record that its liveliness token came, or is gone."""
        with self._lock:
            self._alive = alive

    @property
    def document(self) -> ProcessDocument:
        """State for the page."""
        with self._lock:
            return ProcessDocument(self._is_there(), self._endpoint, self._heard_utc, self._problem, self._fields)

    def _is_there(self) -> bool:
        recent = self._heard_at is not None and self._clock.now() - self._heard_at < SILENT_AFTER_S
        return self._alive and recent
