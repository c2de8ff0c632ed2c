"""Emulate a node that publishes the states of some joints."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.messages import NANO, Header, JointState, encode_joint_state

# Encodes a node's message; None when it is not sent.
Send = Callable[[JointState], bytes | None]


Path = Callable[[float], float]
EPOCH_NS = 1_780_000_000 * NANO


@dataclass(frozen=True, slots=True)
class Sent:
    """An encoded message."""

    payload: bytes
    attached: bytes


class Node:
    """An emulated node.

    Attributes:
        set_by_s: how far its clock was set forward since the start [s].
    """

    def __init__(
        self,
        paths: Mapping[str, Path],
        rate_hz: float,
        *,
        name: str = "robot",
        drift: float = 0.0,
        send: Send = encode_joint_state,
    ) -> None:
        """Create a node that has not published yet.

        Args:
            paths: the position of each joint [rad] or [m] as a function of time [s].
            drift: relative excess of its clock rate over ours.
            send: encodes each message, corrupted or not.
        """
        self.names, self.period_s, self.set_by_s = tuple(paths), 1.0 / rate_hz, 0.0
        self._paths, self._rate, self._send = dict(paths), 1.0 + drift, send
        self._gid = hashlib.blake2b(name.encode(), digest_size=rmw.GID_BYTES).digest()
        self._sequence = 0

    def stamp_ns(self, t: float) -> int:
        """Return its clock's time at `t` [s]."""
        return EPOCH_NS + round((t * self._rate + self.set_by_s) * NANO)

    def at(self, t: float) -> Sent | None:
        """Return the message that it publishes at `t` [s]; None if it is silent."""
        stamp_ns = self.stamp_ns(t)
        positions = tuple(path(t) for path in self._paths.values())
        still = (0.0,) * len(positions)
        payload = self._send(JointState(Header(stamp_ns, "base_link"), self.names, positions, still, still))
        if payload is None:
            return None
        self._sequence += 1
        return Sent(payload, rmw.attachment(self._sequence, stamp_ns, self._gid))
