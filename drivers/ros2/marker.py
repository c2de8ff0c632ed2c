"""Publish the predicted marker position as a ROS 2 topic."""

from __future__ import annotations

import hashlib
import time
from typing import Self

import zenoh

from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.records import FloatArray

from . import rmw
from .config import MarkerTopic, Ros2Config
from .link import open_session
from .messages import POINT_STAMPED, POSE_WITH_COVARIANCE_STAMPED, Header, encode_point, encode_pose

NODE = "bodyschema"
# The marker is a ball without orientation: rotations up to π about each axis are equally likely.
UNKNOWN_TURN_RAD2 = 3.289868  # π² / 3
NO_TURN = (0.0, 0.0, 0.0, 1.0)


class MarkerPublisher:
    """Publisher like a node of rmw_zenoh, visible in `ros2 topic list`. It resumes when the router comes back."""

    def __init__(self, config: Ros2Config, marker: MarkerTopic) -> None:
        self._config, self._marker = config, marker
        self._kind = POINT_STAMPED if marker.message == "point" else POSE_WITH_COVARIANCE_STAMPED
        self._session: zenoh.Session | None = None
        self._tokens: list[zenoh.LivelinessToken] = []
        self._sequence = 0

    period_s = 1.0 / 30.0  # shortest time between two positions

    @property
    def has_sigma(self) -> bool:
        """True if the message carries the uncertainty of a position."""
        return self._marker.message == "pose"

    def __enter__(self) -> Self:
        """Open the topic; raise SourceLost if the router is not reachable."""
        self._session = session = open_session(self._config.router)
        domain, topic, name = self._config.domain, self._marker.topic, str(session.info.zid())
        tokens = (rmw.node_token(domain, name, NODE), rmw.publisher_token(domain, name, NODE, topic, self._kind))
        self._tokens = [session.liveliness().declare_token(token) for token in tokens]
        self._gid = hashlib.blake2b(tokens[1].encode(), digest_size=rmw.GID_BYTES).digest()
        self._publisher = session.declare_publisher(rmw.topic_key(domain, topic, self._kind))
        self._sequence = 0
        return self

    def __exit__(self, *_: object) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None
            self._tokens.clear()

    def publish(self, stamp_ns: int, x: FloatArray, sigma: FloatArray) -> None:
        """Publish the marker's position.

        Args:
            stamp_ns: its time on the robot's clock [ns].
            x: position in the measurement frame [m], shape (3,).
            sigma: its 1-sigma per axis [m], shape (3,); only a pose carries it.
        """
        if self._session is None:
            raise SourceError("the marker's topic is not open; use it in a with statement")
        self._sequence += 1
        header, at = Header(stamp_ns, self._marker.frame), tuple(x.tolist())
        if not self.has_sigma:
            payload = encode_point(header, at)
        else:
            payload = encode_pose(header, at, NO_TURN, _covariance(sigma))
        self._publisher.put(payload, attachment=rmw.attachment(self._sequence, time.time_ns(), self._gid))


def _covariance(sigma: FloatArray) -> tuple[float, ...]:
    diagonal = [*(sigma**2).tolist(), *[UNKNOWN_TURN_RAD2] * 3]
    return tuple(diagonal[row] if row == column else 0.0 for row in range(6) for column in range(6))
