"""Receive messages through a zenoh session with the robot's router."""

from __future__ import annotations

import json
import queue
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import zenoh

from bodyschema.interfaces.errors import SourceLost
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.waits import Waits

from . import rmw
from .config import Ros2Config
from .messages import JOINT_STATE


class LinkSettings:
    retry_s: float = 0.5  # asking for an absent router is cheap
    max_waiting: int = 4096  # messages: four seconds at 1 kHz
    graph_limit_s: float = 1.0  # how long the list of publishers is waited for


@dataclass(frozen=True, slots=True)
class Sample:
    """A received message."""

    payload: bytes
    attached: bytes  # attachment of rmw_zenoh; empty without one
    arrived: float  # time of arrival [s]


class Link(Protocol):
    """A subscription to joint states."""

    @property
    def is_connected(self) -> bool:
        """True while the router is reachable."""
        ...

    def receive(self, until: float) -> Sample | None:
        """Return the next message; None if none arrives by `until` [s] or the router is gone."""

    def tokens(self) -> Sequence[str]:
        """Return the liveliness tokens of all known publishers."""
        ...

    def close(self) -> None:
        """Close the link."""


OpenLink = Callable[[Ros2Config, Clock], Link]


def session_config(mode: str, *, listen: Sequence[str] = (), connect: Sequence[str] = ()) -> zenoh.Config:
    """Return the configuration of a session that does not scout."""
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "timestamping/enabled": True,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_session(router: str, start: str = "ros2 run rmw_zenoh_cpp rmw_zenohd") -> zenoh.Session:
    """Open a session with this router only: it neither listens nor scouts. `start` is the router's start command.

    Raises:
        SourceLost: the router is not reachable.
    """
    try:
        return zenoh.open(session_config("client", connect=[router]))
    except zenoh.ZError as error:
        raise SourceLost(
            f"no zenoh router answers on {router}. Start it on the robot: {start}", retry_s=LinkSettings.retry_s
        ) from error


def is_connected(session: zenoh.Session) -> bool:
    """Return True if the session is connected to a router or peer."""
    return bool(session.info.routers_zid() or session.info.peers_zid())


class ZenohLink:
    """A subscription over zenoh. It must be closed: an open one keeps the process from ending."""

    def __init__(self, session: zenoh.Session, key: str, clock: Clock) -> None:
        """Subscribe to `key`; the session is closed with the link."""
        self._session, self._clock = session, clock
        self._waiting: queue.Queue[Sample] = queue.Queue(LinkSettings.max_waiting)
        # In zenoh's own thread, so that the time of arrival does not depend on the reader.
        handler = zenoh.handlers.Callback(self._take, indirect=False)
        self._subscriber = session.declare_subscriber(key, handler)

    @property
    def is_connected(self) -> bool:
        return is_connected(self._session)

    def receive(self, until: float) -> Sample | None:
        while True:
            left = until - self._clock.now()
            try:
                return self._waiting.get(timeout=min(max(left, 0.0), Waits.poll_s))
            except queue.Empty:
                if left <= Waits.poll_s or not self.is_connected:
                    return None

    def tokens(self) -> Sequence[str]:
        replies = self._session.liveliness().get(rmw.publishers_key(), timeout=LinkSettings.graph_limit_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def close(self) -> None:
        self._session.close()

    def _take(self, sample: zenoh.Sample) -> None:
        attached = b"" if sample.attachment is None else sample.attachment.to_bytes()
        with suppress(queue.Full):
            self._waiting.put_nowait(Sample(sample.payload.to_bytes(), attached, self._clock.now()))


def open_zenoh(config: Ros2Config, clock: Clock) -> Link:
    """Subscribe to the joint states of the configured robot. The type's hash is a wildcard, so any ROS 2 version works.

    Raises:
        SourceLost: the router is not reachable.
    """
    key = rmw.topic_key(config.domain, config.topic, JOINT_STATE, rmw.ANY)
    if config.via == "ros2dds":
        key, session = config.topic.strip("/"), open_session(config.router, "zenoh-bridge-ros2dds -l tcp/0.0.0.0:7447")
    else:
        session = open_session(config.router)
    try:
        return ZenohLink(session, key, clock)
    except BaseException:
        session.close()
        raise
