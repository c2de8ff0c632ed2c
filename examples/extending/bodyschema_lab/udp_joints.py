"""Joint angles that a robot's controller sends by UDP: one datagram a reading, one number [rad] a joint."""

from __future__ import annotations

import math
import socket
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from bodyschema.interfaces.errors import ConfigError, SourceError, SourceLost
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import JointReading, frozen_array

LONGEST = 4096
SILENT_S = 2.0


class UdpJoints:
    """A `JointSource`: see the Protocol in `bodyschema.interfaces.protocols`."""

    def __init__(self, joints: Sequence[str], settings: Mapping[str, Any], clock: Clock) -> None:
        """Nothing is opened yet."""
        unknown = settings.keys() - {"host", "port"}
        if unknown:
            raise ConfigError(f"[drivers.plugin.settings] does not know {', '.join(sorted(unknown))}")
        self._joints, self._clock = tuple(joints), clock
        self._address = settings.get("host", "127.0.0.1"), int(settings.get("port", 5005))
        self._socket: socket.socket | None = None
        self._last_t, self._refused = -math.inf, 0

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the order of q."""
        return self._joints

    @property
    def health(self) -> tuple[str, ...]:
        """The present problem and its remedy; shown by status, joints and doctor."""
        if not self._refused:
            return ()
        return (
            f"{self._refused} datagrams were not {len(self._joints)} numbers: does the controller send all joints?",
        )

    def __enter__(self) -> Self:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(self._address)
        except OSError as error:
            self._socket.close()
            self._socket = None
            raise SourceLost(f"UDP port {self._address[1]}: {error.strerror}. Who else listens there?") from error
        self._last_t = self._clock.now()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def read(self, timeout_s: float) -> JointReading | None:
        """Return the next reading; None if none came within `timeout_s` [s]."""
        if self._socket is None:
            raise SourceError("the UDP port is not open")
        self._socket.settimeout(max(timeout_s, 1e-3))
        try:
            data = self._socket.recv(LONGEST)
        except TimeoutError:
            if self._clock.now() - self._last_t > SILENT_S:
                raise SourceLost("the controller sends nothing. Is it on, and does it send here?") from None
            return None
        t = self._clock.now()
        q = self._parsed(data)
        if q is None or t <= self._last_t:
            return None
        self._last_t = t
        return JointReading(t, frozen_array(q))

    def _parsed(self, data: bytes) -> list[float] | None:
        """Parse a datagram into joint values; None unless it is one finite number a joint."""
        try:
            q = [float(word) for word in data.split()]
        except ValueError:
            q = []
        if len(q) != len(self._joints) or not np.isfinite(q).all():
            self._refused += 1
            return None
        return q
