"""Run the zenoh router that connects several machines, with TLS and roles.

zenoh's own zenohd accepts the same configuration, as a file; here the router runs without installing zenohd.
"""

from __future__ import annotations

import json
import logging
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from bodyschema.daemon.service.notify import Notifier
from bodyschema.daemon.service.service import Service
from bodyschema.daemon.transport.access import EVERY_ROBOT, ROLES, Names, access_control
from bodyschema.daemon.transport.identity import SECURE, Identity, TlsConfig
from bodyschema.daemon.transport.session import SessionSettings, ZenohSession
from bodyschema.daemon.transport.zenoh_config import ENDPOINT, HOW_TO
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.waits import Waits
from bodyschema.robot.description import NAME
from bodyschema.robot.toml_file import convert, line_of, read_toml

log = logging.getLogger(__name__)

PASSING_ON = "passing on"


class RouterTables(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """router.toml."""

    listen: str  # where machines connect, like `tls/0.0.0.0:7450`
    tls: TlsConfig  # the router's certificate, and the authority that signed all certificates
    access: dict[str, Names]  # names per role, by the robot's name, or `*` for every robot
    users_file: str | None = None  # lines `user:password` of permitted users, in place of certificates


@dataclass(frozen=True)
class RouterConfig:
    file: Path
    tables: RouterTables
    identity: Identity

    @classmethod
    def load(cls, file: Path) -> RouterConfig:
        """Read router.toml.

        Raises:
            ConfigError: something is unknown, missing or wrong; the message names file, line, key and remedy.
        """
        raw, text = read_toml(file, written_by="docs/security.md has one to begin with")
        tables = convert(raw, RouterTables, file=file, text=text)

        def refuse(what: str, remedy: str, *keys: str) -> None:
            raise ConfigError(what, file=file, line=line_of(text, keys), remedy=remedy)

        if not (ENDPOINT.fullmatch(tables.listen) and tables.listen.startswith(SECURE)):
            what = f"listen: {tables.listen!r} is no endpoint with TLS"
            refuse(what, f"Write one like tls/0.0.0.0:7450; {HOW_TO}", "listen")
        if tables.tls.certificate is None:
            refuse("tls: a router needs a certificate of its own", f"Name certificate and key; {HOW_TO}", "tls")
        for robot, names in tables.access.items():
            if robot != EVERY_ROBOT and not re.match(NAME, robot):
                refuse(f"access: {robot!r} is no robot's name", 'Write one, or "*" for every robot', "access", robot)
            if not any(getattr(names, role) for role in ROLES):
                refuse(f"access.{robot}: no one has a role", f"Known are: {', '.join(ROLES)}", "access", robot)
        if not tables.access:
            refuse("access: no one may do anything", 'Begin with [access."*"] and viewer = ["a name"]', "access")
        try:
            identity = Identity.of(tables.tls, None, tables.users_file, file.parent)
        except ConfigError as error:
            raise ConfigError(error.what, file=file, line=line_of(text, ("tls",)), remedy=error.remedy) from error
        return cls(file, tables, identity)

    def settings(self) -> dict[str, Any]:
        """Return zenoh's configuration, by path."""
        return {
            "mode": "router",
            "listen/endpoints": [self.tables.listen],
            "connect/endpoints": [],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "timestamping/enabled": True,
            "transport/link/tx/lease": SessionSettings.lease_ms,
            "transport/link/rx/max_message_size": SessionSettings.largest_reply_bytes,
            "access_control": access_control(self.tables.access, by_user=self.identity.by_user),
            **self.identity.settings(),
        }

    def as_zenohd(self) -> str:
        """Return the same as a file for zenohd, with this machine's absolute paths."""
        nested: dict[str, Any] = {}
        for path, value in self.settings().items():
            *parents, last = path.split("/")
            table = nested
            for parent in parents:
                table = table.setdefault(parent, {})
            table[last] = value
        return json.dumps(nested, indent=2)


def run_router(config: RouterConfig, stopping: Callable[[], bool], notifier: Notifier, clock: Clock) -> None:
    """Route permitted messages until `stopping()`.

    Args:
        notifier: reports to systemd that the router accepts connections, and that it is alive.

    Raises:
        BusError: the port is in use, or zenoh cannot use the certificates.
    """
    with ZenohSession(listen=config.tables.listen, settings=config.settings()):
        robots = ", ".join(config.tables.access)
        log.info("the router takes connections on %s; it has roles for: %s", config.tables.listen, robots)
        service = Service(notifier, (PASSING_ON,), clock)
        service.ready()
        service.report_status(f"takes connections on {config.tables.listen}")
        while not stopping():
            service.beat(PASSING_ON)
            time.sleep(Waits.poll_s)
        service.stopping()
