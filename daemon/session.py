"""What a store keeps of each run of the sampler."""

from __future__ import annotations

import socket
from importlib.metadata import version

import msgspec

from interfaces.protocols import Clock

from .config import Config
from .store import Session


def session_of(config: Config, wall: Clock) -> Session:
    """The session that begins now with `config`."""
    return Session(
        joints=config.robot.joints,
        started_utc=wall.utc(),
        robot_toml=config.file.read_text(encoding="utf-8"),
        urdf=config.robot.tree.file.read_text(encoding="utf-8", errors="replace"),
        config=msgspec.json.encode(config.tables).decode(),
        version=version("bodyschema"),
        host=socket.gethostname(),
    )
