"""Emulate a robot over zenoh in real time: one session is router and node."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any, Literal, Self

import zenoh

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.link import session_config
from bodyschema.drivers.ros2.messages import JOINT_STATE

from .node import Node


class ZenohRobot:
    """Publisher of nodes' joint states, as rmw_zenoh would send them; its process is the router too."""

    def __init__(
        self,
        nodes: Sequence[Node],
        listen: str,  # endpoint of the router, such as tcp/127.0.0.1:7447
        *,
        domain: int = 0,
        topic: str = "/joint_states",
        via: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh",
    ) -> None:
        self._via = via
        self._nodes, self._listen, self._domain, self._topic = list(nodes), listen, domain, topic
        self._session: zenoh.Session | None = None
        self._threads: list[threading.Thread] = []
        self._stop = threading.Event()
        self.published = 0

    def __enter__(self) -> Self:
        self._session = session = zenoh.open(session_config("router", listen=[self._listen]))
        self._stop.clear()
        key = self._topic.strip("/")
        if self._via == "rmw_zenoh":
            token = rmw.publisher_token(self._domain, str(session.info.zid()), "emulator", self._topic, JOINT_STATE)
            self._token = session.liveliness().declare_token(token)
            key = rmw.topic_key(self._domain, self._topic, JOINT_STATE)
        # Like a robot with rmw_zenoh, drop messages that a slow reader cannot take.
        self._publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        if self._session is not None:
            self._session.close()
            self._session = None

    @property
    def is_heard(self) -> bool:
        status: Any = self._publisher.matching_status  # zenoh's stub wrongly declares it as bool
        return bool(status.matching)

    def publish(self, node: Node, t: float) -> None:
        """Publish a node's message of time `t` [s]."""
        sent = node.at(t)
        if sent is not None:
            self._publisher.put(sent.payload, attachment=sent.attached if self._via == "rmw_zenoh" else None)
            self.published += 1

    def start(self) -> None:
        """Publish the messages of all nodes, each at its rate, until the end."""
        self._threads = [threading.Thread(target=self._run, args=(node,), name="emulator") for node in self._nodes]
        for thread in self._threads:
            thread.start()

    def _run(self, node: Node) -> None:
        due = time.monotonic()
        while not self._stop.wait(max(0.0, due - time.monotonic())):
            self.publish(node, due)
            due += node.period_s
