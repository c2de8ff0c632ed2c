"""Where messages come from: a zenoh session with the robot's router."""

from __future__ import annotations

import json
import queue
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import zenoh

from bodyschema.interfaces.errors import SourceLost
from bodyschema.interfaces.protocols import Clock

from . import rmw
from .config import Ros2Config
from .messages import JOINT_STATE

RETRY_S = 0.5  # a router that is not there is cheap to ask for
WAITING = 4096  # messages: four seconds at 1 kHz
LOOK_EVERY_S = 0.1  # whether the router is still there
GRAPH_LIMIT_S = 1.0


@dataclass(frozen=True, slots=True)
class Sample:
    """A message as it came.

    Attributes:
        attached: what rmw_zenoh sends with it; empty where there is nothing.
        arrived: when [s].
    """

    payload: bytes
    attached: bytes
    arrived: float


class Link(Protocol):
    """A subscription to joint states."""

    @property
    def overflowed(self) -> int:
        """Messages that were thrown away because nobody took them."""
        ...

    @property
    def is_connected(self) -> bool:
        """Whether the router is there."""
        ...

    def receive(self, until: float) -> Sample | None:
        """The next message; None when none has come by `until` [s], or the router is gone."""
        ...

    def tokens(self) -> Sequence[str]:
        """The liveliness tokens of all publishers that are known."""
        ...

    def close(self) -> None:
        """Nothing comes any more."""
        ...


OpenLink = Callable[[Ros2Config, Clock], Link]


def open_session(router: str) -> zenoh.Session:
    """A session with the router alone: it listens nowhere and looks for nobody.

    Raises:
        SourceLost: the router is not there.
    """
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": [],
        "connect/endpoints": [router],
        "timestamping/enabled": True,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise SourceLost(
            f"no zenoh router answers on {router}. Start it on the robot: ros2 run rmw_zenoh_cpp rmw_zenohd",
            retry_s=RETRY_S,
        ) from error


def is_connected(session: zenoh.Session) -> bool:
    """Whether anybody is at the other end."""
    return bool(session.info.routers_zid() or session.info.peers_zid())


class ZenohLink:
    """A subscription over zenoh. It has to be closed: an open one keeps the process from ending."""

    def __init__(self, session: zenoh.Session, key: str, clock: Clock) -> None:
        """Subscribe to `key`; the session is closed with the link."""
        self._session, self._clock = session, clock
        self._waiting: queue.Queue[Sample] = queue.Queue(WAITING)
        self.overflowed = 0
        # In zenoh's own thread: the time of arrival does not depend on when somebody reads.
        handler = zenoh.handlers.Callback(self._take, indirect=False)
        self._subscriber = session.declare_subscriber(key, handler)

    @property
    def is_connected(self) -> bool:
        """Whether the router is there."""
        return is_connected(self._session)

    def receive(self, until: float) -> Sample | None:
        """The next message; None when none has come by `until` [s], or the router is gone."""
        while True:
            left = until - self._clock.now()
            try:
                return self._waiting.get(timeout=min(max(left, 0.0), LOOK_EVERY_S))
            except queue.Empty:
                if left <= LOOK_EVERY_S or not self.is_connected:
                    return None

    def tokens(self) -> Sequence[str]:
        """The liveliness tokens of all publishers that are known."""
        replies = self._session.liveliness().get(rmw.publishers_key(), timeout=GRAPH_LIMIT_S)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def close(self) -> None:
        """Nothing comes any more."""
        self._session.close()

    def _take(self, sample: zenoh.Sample) -> None:
        attached = b"" if sample.attachment is None else sample.attachment.to_bytes()
        try:
            self._waiting.put_nowait(Sample(sample.payload.to_bytes(), attached, self._clock.now()))
        except queue.Full:
            self.overflowed += 1


def open_zenoh(config: Ros2Config, clock: Clock) -> Link:
    """The joint states of the configured robot, of whatever ROS 2 version: the type is told, its hash is not.

    Raises:
        SourceLost: the router is not there.
    """
    session = open_session(config.router)
    try:
        return ZenohLink(session, rmw.topic_key(config.domain, config.topic, JOINT_STATE, rmw.ANY), clock)
    except BaseException:
        session.close()
        raise
