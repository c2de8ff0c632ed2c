"""The part of robot.toml that a client of sampler and learner needs, without the processes' packages (no numpy)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import msgspec
from msgspec import Meta

from bodyschema.daemon.transport.identity import Route
from bodyschema.daemon.transport.zenoh_config import ZenohConfig
from bodyschema.interfaces.errors import BusError, ConfigError, RequestError
from bodyschema.robot.limited import read_at_most
from bodyschema.robot.toml_file import NAME, convert, read_toml

# Variables that override what is read here.
OVERRIDES = ("BODYSCHEMA_ROBOT_", "BODYSCHEMA_ZENOH_")


class _Plain(ElementTree.TreeBuilder):
    """Parser that refuses a DOCTYPE, as `parse_urdf` does: entities are not expanded."""

    def doctype(self, *_: object) -> None:
        raise ValueError("a DOCTYPE")


class _Robot(msgspec.Struct, frozen=True):
    name: Annotated[str, Meta(pattern=NAME)]
    urdf: str
    joints: Annotated[tuple[str, ...], Meta(min_length=1)]


class _Tables(msgspec.Struct, frozen=True):
    robot: _Robot
    zenoh: ZenohConfig = ZenohConfig()


@dataclass(frozen=True)
class ClientConfig:
    """The robot's name, its joints, and the endpoints of its processes.

    `Config` reads and checks everything else; clients leave that to the processes, which saves half of the time.
    """

    file: Path  # robot.toml
    name: str
    joints: tuple[str, ...]
    urdf: Path  # file of the URDF
    zenoh: ZenohConfig

    @classmethod
    def load(cls, file: Path, environment: Mapping[str, str] = os.environ) -> ClientConfig:
        """Read robot.toml; if it is wrong or the environment overrides it, read it as `Config.load` does."""
        if not any(variable.startswith(OVERRIDES) for variable in environment):
            try:
                raw, text = read_toml(file)
                tables = convert(raw, _Tables, file=file, text=text)
                tables.zenoh.check(file, text)
                robot = tables.robot
                return cls(file, robot.name, robot.joints, file.parent / robot.urdf, tables.zenoh)
            except ConfigError:
                pass
        from bodyschema.daemon.config import Config

        full = Config.load(file, environment)
        robot = full.robot.robot
        return cls(file, robot.name, robot.joints, file.parent / robot.urdf, full.tables.zenoh)

    def route(self, process: str) -> Route:
        """Return the endpoint and identity with which a client connects to `sampler` or `learner`."""
        return self.zenoh.route(process, self.file.parent)

    def fault(self) -> str:
        """Check all of robot.toml. Return why no process starts with it on this machine, or ""."""
        from bodyschema.daemon.config import Config

        try:
            Config.load(self.file)
        except ConfigError as error:
            return f"With this robot.toml it cannot start on this machine: {error}"
        return ""

    @contextmanager
    def checked_on_error(self) -> Iterator[None]:
        """Add the fault of a wrong robot.toml to an error that it may have caused: no answer."""
        try:
            yield
        except (BusError, RequestError) as error:
            if fault := self.fault():
                raise type(error)(f"{error}. {fault}") from error
            raise

    @cached_property
    def joint_limits(self) -> Mapping[str, tuple[str, float, float]]:
        """Type and limits [rad; m for a prismatic joint] of each joint of the URDF, by name.

        Raises:
            ConfigError: the file is not a URDF.
        """
        try:
            found = ElementTree.fromstring(read_at_most(self.urdf), ElementTree.XMLParser(target=_Plain())).findall(
                "joint"
            )
            return {joint.attrib["name"]: (joint.attrib["type"], *_limits(joint.find("limit"))) for joint in found}
        except (OSError, ElementTree.ParseError, LookupError, ValueError):
            from bodyschema.daemon.config import Config

            tree = Config.load(self.file).robot.tree
            return {name: (joint.kind, joint.lower, joint.upper) for name, joint in tree.joints.items()}

    @property
    def slides(self) -> tuple[bool, ...]:
        """True for each prismatic joint among `joints`."""
        return tuple(name in self.joint_limits and self.joint_limits[name][0] == "prismatic" for name in self.joints)


def _limits(limit: ElementTree.Element | None) -> tuple[float, float]:
    return (0.0, 0.0) if limit is None else (float(limit.get("lower", "0")), float(limit.get("upper", "0")))
