"""Describe each run of the sampler for the store."""

from __future__ import annotations

import socket
from importlib.metadata import version

import msgspec

from bodyschema.daemon.config import Config
from bodyschema.interfaces.protocols import Clock
from bodyschema.recordings.store.store import Session
from bodyschema.robot.limited import read_at_most
from bodyschema.robot.toml_file import read_toml


def session_of(config: Config, wall: Clock) -> Session:
    """Return the session that starts now with `config`."""
    return Session(
        joints=config.robot.joints,
        started_utc=wall.utc(),
        robot_toml=read_toml(config.file)[1],
        urdf=read_at_most(config.robot.tree.file).decode("utf-8", errors="replace"),
        config=msgspec.json.encode(config.tables).decode(),
        version=version("bodyschema"),
        host=socket.gethostname(),
    )
