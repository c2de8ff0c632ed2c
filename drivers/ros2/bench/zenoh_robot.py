"""A robot over zenoh: one session that is router and node, in real time."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import zenoh

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.messages import JOINT_STATE

from .node import Node


class ZenohRobot:
    """Publishes nodes' joint states as rmw_zenoh would; the process that holds it is the router too.

    Attributes:
        published: messages so far.
    """

    def __init__(self, nodes: Sequence[Node], listen: str, *, domain: int = 0, topic: str = "/joint_states") -> None:
        """Nothing is opened yet.

        Args:
            listen: where the router listens, like tcp/127.0.0.1:7447.
        """
        self._nodes, self._listen, self._domain, self._topic = list(nodes), listen, domain, topic
        self._session: zenoh.Session | None = None
        self._threads: list[threading.Thread] = []
        self._stop = threading.Event()
        self.published = 0

    def __enter__(self) -> Self:
        config = zenoh.Config()
        settings: dict[str, Any] = {
            "mode": "router",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "listen/endpoints": [self._listen],
            "connect/endpoints": [],
            "timestamping/enabled": True,
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        self._session = session = zenoh.open(config)
        self._stop.clear()
        token = rmw.publisher_token(self._domain, str(session.info.zid()), "bench", self._topic, JOINT_STATE)
        self._token = session.liveliness().declare_token(token)
        key = rmw.topic_key(self._domain, self._topic, JOINT_STATE)
        # rmw_zenoh drops what a slow reader cannot take, and so would a robot.
        self._publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        if self._session is not None:
            self._session.close()
            self._session = None

    @property
    def is_heard(self) -> bool:
        """Whether anybody subscribes."""
        status: Any = self._publisher.matching_status  # zenoh's stub calls it a bool, which it is not
        return bool(status.matching)

    def publish(self, node: Node, t: float) -> None:
        """Let a node publish what is true at `t` [s]."""
        sent = node.at(t)
        if sent is not None:
            self._publisher.put(sent.payload, attachment=sent.attached)
            self.published += 1

    def start(self) -> None:
        """Let all nodes publish, each at its rate, until the end."""
        self._threads = [threading.Thread(target=self._run, args=(node,), name="bench") for node in self._nodes]
        for thread in self._threads:
            thread.start()

    def _run(self, node: Node) -> None:
        due = time.monotonic()
        while not self._stop.wait(max(0.0, due - time.monotonic())):
            self.publish(node, due)
            due += node.period_s
