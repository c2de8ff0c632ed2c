"""Conventions of rmw_zenoh: topic keys, attachments of messages, and liveliness tokens of nodes.

Source: docs/design.md of ros2/rmw_zenoh.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from .messages import MessageType

ANY = "*"
GRAPH = "@ros2_lv"
PUBLISHER = "MP"
GID_BYTES = 16
DOMAIN = re.compile(r"[0-9]{1,3}")  # 0 … 232
# Reliable, volatile, keep the last 10. A field is empty where it is rmw_zenoh's default, whose depth is 42.
QOS = "::,10:,:,:,,"
LATCHED_QOS = ":1:,1:,:,:,,"  # transient local, keep the last one
# Sizes of attachments: since rmw_zenoh 0.2.4, and before, with field names.
ATTACHMENT_BYTES, NAMED_ATTACHMENT_BYTES = 33, 77


def topic_key(domain: int, topic: str, kind: MessageType, digest: str = "") -> str:
    """Return the zenoh key of a topic's messages; the hash is the type's own, unless `digest` is given."""
    return f"{domain}/{topic.strip('/')}/{kind.name}/{digest or kind.digest}"


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """Build a message's attachment: its number from 1 on, time of sending [ns since 1970], and the sender's gid."""
    return struct.pack("<qqB16s", sequence, stamp_ns, GID_BYTES, gid)


def sender_of(attached: bytes) -> tuple[bytes, int | None]:
    """Return the sender's gid and the message's sequence number; empty and None if unknown."""
    if len(attached) == ATTACHMENT_BYTES and attached[16] == GID_BYTES:
        return attached[17:], int.from_bytes(attached[:8], "little", signed=True)
    if len(attached) == NAMED_ATTACHMENT_BYTES and attached[-GID_BYTES - 1] == GID_BYTES:
        return attached[-GID_BYTES:], int.from_bytes(attached[16:24], "little", signed=True)
    return b"", None


def node_token(domain: int, session: str, node: str) -> str:
    """Return the liveliness token of a node, the first entity of its session."""
    return f"{GRAPH}/{domain}/{session}/0/0/NN/%/%/{node}"


def publisher_token(domain: int, session: str, node: str, topic: str, kind: MessageType, qos: str = QOS) -> str:
    """Return the liveliness token of that node's publisher, the second entity of the session."""
    mangled = "%" + topic.strip("/").replace("/", "%")
    return f"{GRAPH}/{domain}/{session}/0/1/{PUBLISHER}/%/%/{node}/{mangled}/{kind.name}/{kind.digest}/{qos}"


def publishers_key() -> str:
    """Return the key of the tokens of all publishers in all domains."""
    return f"{GRAPH}/*/*/*/*/{PUBLISHER}/**"


@dataclass(frozen=True, slots=True)
class Topic:
    """Content of a publisher's token."""

    domain: int
    name: str
    type: str


def topics_in(tokens: list[str]) -> Iterator[Topic]:
    """Yield the topics of publishers' tokens; skip anything else."""
    for token in tokens:
        parts = token.split("/")
        if len(parts) >= 13 and parts[0] == GRAPH and parts[5] == PUBLISHER and DOMAIN.fullmatch(parts[1]):
            yield Topic(int(parts[1]), parts[9].replace("%", "/"), parts[10])
