"""The table [marker_source] of robot.toml, or several as [[marker_source]]."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from bodyschema.drivers.ros2.config import TOPIC
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.rpy import pose_of
from bodyschema.robot.suggest import did_you_mean
from bodyschema.robot.toml_file import ENDPOINT, NonNegative, Positive, convert, line_in_entry, line_of

TABLE = "marker_source"
PAGE = "docs/marker_sources.md"

Port = Annotated[int, Meta(ge=1, le=65535)]
Vector3 = tuple[float, float, float]
Mistake = tuple[str, str, str]


class SourceTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind"):
    """Keys that all kinds of marker source share."""

    name: str = ""  # in messages; the kind without it
    body: str | int | None = None  # the body whose positions are used; without it, only one may be sent
    unit: Literal["m", "mm"] = "m"  # of the positions and their covariances that are sent
    sigma_m: Positive = 1e-3  # 1-sigma per axis of a position that comes without a covariance [m]
    latency_s: float = 0.0  # from the measurement to its timestamp [s]; `bodyschema calibrate latency` measures it
    latency_sigma_s: NonNegative | None = None  # its 1-sigma [s]
    max_delay_s: Positive = 0.1  # a message is rejected if it arrives this much later than the fastest one
    # xyz, rpy: pose of the source's frame in the measurement frame [m], [rad]; for several sources
    xyz: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)

    # A sender's own stamp is taken when its computation ends, or its frame arrives: milliseconds from the exposure.
    usual_sigma_s: ClassVar[float] = 0.005

    @property
    def kind(self) -> str:
        """The kind, as in robot.toml."""
        return str(self.__struct_config__.tag)

    @property
    def label(self) -> str:
        """The name in messages."""
        return self.name or self.kind

    @property
    def sigma_s(self) -> float:
        """1-sigma of the latency [s]."""
        return self.usual_sigma_s if self.latency_sigma_s is None else self.latency_sigma_s

    @property
    def metres(self) -> float:
        """Metres per unit."""
        return 1e-3 if self.unit == "mm" else 1.0

    @property
    def pose(self) -> FloatArray:
        """Pose of the source's frame in the measurement frame, shape (4, 4)."""
        return pose_of(np.array(self.xyz), np.array(self.rpy))

    @property
    def endpoint(self) -> str:
        """The endpoint it listens on or connects to, as protocol/host:port."""
        raise NotImplementedError

    def mistakes(self) -> Iterator[Mistake]:
        """Yield key, fault and remedy of each value that cannot be used."""
        yield from ()


class UdpTable(SourceTable, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="udp"):
    """kind = "udp": JSON datagrams to a port of this machine."""

    # address to listen on: 127.0.0.1 takes them from this machine only, 0.0.0.0 from the network
    host: str = "127.0.0.1"
    port: Port = 5005  # to listen on
    sender: str | None = None  # the only address that datagrams are taken from; without it, any

    @property
    def endpoint(self) -> str:
        return f"udp/{self.host}:{self.port}"

    def mistakes(self) -> Iterator[Mistake]:
        yield from _addresses(self, "host", "sender")


class NatnetTable(SourceTable, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="natnet"):
    """kind = "natnet": OptiTrack Motive, which streams NatNet 3 or 4.

    Attributes:
        body: name or streaming ID of the rigid body.
    """

    server: str = "127.0.0.1"  # address of the machine that runs Motive
    local: str = "0.0.0.0"  # address of this machine's network interface to it, for multicast
    command_port: Port = 1510  # where Motive answers
    sigma_m: Positive = 3e-4

    # Motive's clock dates the middle of the exposure.
    usual_sigma_s: ClassVar[float] = 0.5e-3

    @property
    def endpoint(self) -> str:
        return f"udp/{self.server}:{self.command_port}"

    def mistakes(self) -> Iterator[Mistake]:
        yield from _addresses(self, "server", "local")


class ZenohTable(SourceTable, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="zenoh"):
    """kind = "zenoh": the same JSON as by UDP, published on a zenoh key."""

    router: str = "tcp/127.0.0.1:7447"  # endpoint of the zenoh router or peer
    key: str = "marker"  # that is published on

    @property
    def endpoint(self) -> str:
        return self.router

    def mistakes(self) -> Iterator[Mistake]:
        yield from _endpoints(self)
        if not re.fullmatch(r"[^/*$?#\s]+(/[^/*$?#\s]+)*", self.key):
            yield "key", f"{self.key!r} is no zenoh key without wild cards", "Write one such as lab/marker"


class Ros2Table(SourceTable, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="ros2"):
    """kind = "ros2": a topic with the marker's pose or point, or a transform of TF."""

    router: str = "tcp/127.0.0.1:7447"  # where rmw_zenohd, or the zenoh bridge, listens
    via: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh"  # rmw_zenoh, or zenoh-bridge-ros2dds for robots on DDS
    domain: Annotated[int, Meta(ge=0, le=232)] = 0  # ROS_DOMAIN_ID, for rmw_zenoh
    topic: str = "/marker"  # name of the topic
    # its type; `tf` reads the transform from `frame` to `child` in tf2_msgs/TFMessage
    message: Literal["pose", "point", "pose_with_covariance", "transform", "tf"] = "pose"
    frame: str | None = None  # the frame the positions are given in; without it, the frame of the first message
    child: str | None = None  # the marker's frame, for `tf`

    @property
    def endpoint(self) -> str:
        return self.router

    def mistakes(self) -> Iterator[Mistake]:
        yield from _endpoints(self)
        if not TOPIC.fullmatch(self.topic):
            yield "topic", f"{self.topic!r} is no name of a topic", "Write one as `ros2 topic list` does"
        if self.message == "tf" and self.child is None:
            yield "message", "TF has many transforms", "Name the marker's frame as child, and its parent as frame"
        if self.body is not None:
            yield "body", "a topic has no bodies", "For TF name the marker's frame as child"


AnySource = UdpTable | NatnetTable | ZenohTable | Ros2Table
KINDS: Mapping[str, type[AnySource]] = {
    str(table.__struct_config__.tag): table for table in (UdpTable, NatnetTable, ZenohTable, Ros2Table)
}


def source_tables(raw: object, file: Path, text: str) -> tuple[AnySource, ...]:
    """Return the sources in the value `raw` of marker_source.

    Raises:
        ConfigError: a kind or key is unknown, a value is wrong, or two sources have the same name.
    """
    entries = raw if isinstance(raw, list) else [raw]
    found: list[AnySource] = []
    for place, entry in enumerate(entries):
        alone = text if raw is entry else _entry_alone(text, place)
        found.append(_source(entry, file, alone))
        names = [source.label for source in found[:-1]]
        if found[-1].label in names:
            raise ConfigError(
                f"two marker sources have the name {names[-1]!r}",
                file=file,
                line=line_in_entry(text, TABLE, place, "name"),
                remedy="Give each its own name",
            )
    return tuple(found)


def _source(entry: object, file: Path, text: str) -> AnySource:
    line = line_of(text, (TABLE, "kind"))
    if not isinstance(entry, dict):
        raise ConfigError(f"{TABLE} is no table", file=file, line=line, remedy=f"Write [{TABLE}]: {PAGE}")
    kind = entry.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        what = f"the kind is missing in [{TABLE}]" if kind is None else f"{TABLE}.kind: {kind!r} is unknown"
        raise ConfigError(what, file=file, line=line, remedy=did_you_mean(str(kind), KINDS))
    source = convert(entry, KINDS[kind], file=file, text=text, prefix=(TABLE,))
    for key, what, remedy in source.mistakes():
        raise ConfigError(f"{TABLE}.{key}: {what}", file=file, line=line_of(text, (TABLE, key)), remedy=remedy)
    return source


def _entry_alone(text: str, place: int) -> str:
    """Return the text with all other entries of the array of tables blanked, so that line numbers stay the same."""
    lines = text.splitlines()
    begin = (line_in_entry(text, TABLE, place) or 1) - 1
    end = next((k for k in range(begin + 1, len(lines)) if lines[k].lstrip().startswith("[")), len(lines))
    return "\n".join(line if begin <= number < end else "" for number, line in enumerate(lines))


def _addresses(table: SourceTable, *keys: str) -> Iterator[Mistake]:
    for key in keys:
        value = getattr(table, key)
        try:
            ipaddress.IPv4Address("0.0.0.0" if value is None else value)
        except ValueError:
            yield key, f"{value!r} is no IPv4 address", "Write one such as 192.168.1.20"


def _endpoints(table: ZenohTable | Ros2Table) -> Iterator[Mistake]:
    if not ENDPOINT.fullmatch(table.router):
        yield "router", f"{table.router!r} is no endpoint", "Write tcp/127.0.0.1:7447"
