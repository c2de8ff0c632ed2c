"""Read encoders continuously in a thread, so that no line waits in a buffer."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Self

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.protocols import JointSource
from bodyschema.interfaces.records import JointReading

READ_S = 0.1


class Listener:
    """Thread that reads an open source and keeps the newest reading."""

    def __init__(self, source: JointSource) -> None:
        """Start without a reading."""
        self._source = source
        self._newest: JointReading | None = None
        self._error: BodyschemaError | None = None
        self._told, self._stop = threading.Condition(), threading.Event()
        self._thread = threading.Thread(target=self._listen, name="bench listener")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    def after(self, t: float, timeout_s: float) -> JointReading | None:
        """Return the first reading measured after `t` [s]; None when there is none in time.

        Raises:
            BodyschemaError: the error that ended the reading.
        """
        with self._told:
            self._told.wait_for(lambda: self._error is not None or self._is_after(t), timeout_s)
            if self._error is not None:
                raise self._error
            return self._newest if self._is_after(t) else None

    def _is_after(self, t: float) -> bool:
        return self._newest is not None and self._newest.t > t

    def _listen(self) -> None:
        try:
            while not self._stop.is_set():
                reading = self._source.read(READ_S)
                if reading is not None:
                    with self._told:
                        self._newest = reading
                        self._told.notify_all()
        except BodyschemaError as error:
            with self._told:
                self._error = error
                self._told.notify_all()
