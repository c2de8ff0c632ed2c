"""A node that publishes the states of some joints."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.messages import NANO, Header, JointState

from .faults import Send, intact

Path = Callable[[float], float]
EPOCH_NS = 1_780_000_000 * NANO


@dataclass(frozen=True, slots=True)
class Sent:
    """A message on the wire."""

    payload: bytes
    attached: bytes


class Node:
    """What it publishes at any time.

    Attributes:
        names: of its joints.
        period_s: between two messages.
        set_by_s: how much its clock was set forwards since the start [s].
    """

    def __init__(
        self, paths: Mapping[str, Path], rate_hz: float, *, name: str = "robot", drift: float = 0.0, send: Send = intact
    ) -> None:
        """A node that has said nothing.

        Args:
            paths: the position of each joint [rad] or [m] at any time [s].
            rate_hz: how often it publishes.
            name: tells its gid from other nodes'.
            drift: how much faster its clock runs than ours.
            send: makes bytes of each message, spoilt ones perhaps.
        """
        self.names, self.period_s, self.set_by_s = tuple(paths), 1.0 / rate_hz, 0.0
        self._paths, self._rate, self._send = dict(paths), 1.0 + drift, send
        self._gid = hashlib.blake2b(name.encode(), digest_size=rmw.GID_BYTES).digest()
        self._sequence = 0

    def stamp_ns(self, t: float) -> int:
        """What its clock shows at `t` [s]."""
        return EPOCH_NS + round((t * self._rate + self.set_by_s) * NANO)

    def at(self, t: float) -> Sent | None:
        """The message that it publishes at `t` [s]; None when it is silent."""
        stamp_ns = self.stamp_ns(t)
        positions = tuple(path(t) for path in self._paths.values())
        still = (0.0,) * len(positions)
        payload = self._send(JointState(Header(stamp_ns, "base_link"), self.names, positions, still, still))
        if payload is None:
            return None
        self._sequence += 1
        return Sent(payload, rmw.attachment(self._sequence, stamp_ns, self._gid))
