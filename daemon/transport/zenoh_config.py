"""The table [zenoh] of robot.toml: endpoints of the processes, and access to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.toml_file import ENDPOINT, line_of

from .access import Names, access_control
from .identity import SECURE, Identity, LoginConfig, Route, TlsConfig, is_local

PROCESSES = ("sampler", "learner")
HOW_TO = "docs/security.md shows how"


class ZenohConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [zenoh]."""

    # sampler, learner: endpoints of the two processes. Beyond this machine only with `tls` and `access`.
    sampler: str = "tcp/127.0.0.1:7447"
    learner: str = "tcp/127.0.0.1:7448"
    # endpoint where machines meet: both processes connect to it too, and clients that do not find them on this machine
    # ask there; may be empty
    router: str = ""
    tls: TlsConfig | None = None  # certificates; required for every endpoint beyond this machine
    login: LoginConfig | None = None  # name and password for a router or a process that asks for them
    # lines `user:password` of users who may connect to the processes, in place of certificates
    users_file: str | None = None
    access: Names | None = None  # roles at the processes, if they listen beyond this machine

    def endpoint(self, process: str) -> str:
        """Return the endpoint of `sampler` or `learner`."""
        return self.learner if process == "learner" else self.sampler

    @property
    def files(self) -> tuple[str, ...]:
        """Certificates, keys and passwords, as named in the table."""
        tls, login = self.tls, self.login
        named = (
            *(() if tls is None else (tls.ca, tls.certificate, tls.key)),
            None if login is None else login.password_file,
            self.users_file,
        )
        return tuple(name for name in named if name is not None)

    def identity(self, folder: Path) -> Identity | None:
        """Return this machine's credentials, None without certificates; raise ConfigError if its files are unusable."""
        return None if self.tls is None else Identity.of(self.tls, self.login, self.users_file, folder)

    def check(self, file: Path, text: str) -> None:
        """Raise ConfigError with the line if an endpoint is invalid, or open to the network without protection."""

        def refuse(key: str, what: str, remedy: str) -> None:
            raise ConfigError(f"zenoh.{key}{what}", file=file, line=line_of(text, ("zenoh", key)), remedy=remedy)

        endpoints = {"sampler": self.sampler, "learner": self.learner, "router": self.router}
        for name, endpoint in endpoints.items():
            if name == "router" and not endpoint:
                continue
            if not ENDPOINT.fullmatch(endpoint):
                refuse(name, f": {endpoint!r} is no endpoint", "Write one like tcp/127.0.0.1:7447")
            if is_local(endpoint):
                continue
            if not endpoint.startswith(SECURE):
                protocol = endpoint.partition("/")[0]
                what = f": {endpoint} is open to the network, and {protocol} neither authenticates nor encrypts"
                refuse(name, what, f"{_instead(name, endpoint)}; {HOW_TO}")
            if self.tls is None:
                refuse(name, f": {endpoint} needs certificates", f"Name them in [zenoh.tls]; {HOW_TO}")
        if self.sampler == self.learner:
            refuse("learner", ": sampler and learner have the same endpoint", "Give two")
        for name in PROCESSES:
            self._check_listening(name, refuse)
        self._check_identity(file, text)

    def _check_listening(self, name: str, refuse: Any) -> None:
        endpoint = self.endpoint(name)
        if not endpoint.startswith(SECURE):
            return
        if self.tls is None or self.tls.certificate is None:
            refuse(name, f": to listen on {endpoint} takes a certificate", f"Name it in [zenoh.tls]; {HOW_TO}")
        if self.access is None:
            refuse(name, f": no one may do anything on {endpoint}", f"Say who may in [zenoh.access]; {HOW_TO}")

    def _check_identity(self, file: Path, text: str) -> None:
        if self.tls is None and (self.login is not None or self.users_file is not None):
            key = "login" if self.login is not None else "users_file"
            line = line_of(text, ("zenoh", key))
            remedy = f"Name the certificates in [zenoh.tls]; {HOW_TO}"
            raise ConfigError(f"zenoh.{key}: passwords go over TLS only", file=file, line=line, remedy=remedy)
        try:
            self.identity(file.parent)
        except ConfigError as error:
            line = line_of(text, ("zenoh", "tls"))
            raise ConfigError(error.what, file=file, line=line, remedy=error.remedy) from error

    def route(self, process: str, folder: Path) -> Route:
        """Return the route to the process: on this machine, or through the router."""
        own = self.endpoint(process)
        endpoints = (own, self.router) if self.router else (own,)
        return Route(endpoints, self.identity(folder))

    def settings_of(self, process: str, robot: str, folder: Path) -> dict[str, Any]:
        """Return zenoh's configuration of the process, apart from the settings that all our sessions share."""
        connect = [self.sampler] if process == "learner" else []
        settings: dict[str, Any] = {
            "listen/endpoints": [self.endpoint(process)],
            "connect/endpoints": [*connect, self.router] if self.router else connect,
        }
        if self.router:
            # A router forwards nothing between peers, which do not know each other here.
            settings["mode"] = "router"
        identity = self.identity(folder)
        if identity is not None:
            settings |= identity.settings()
            if self.endpoint(process).startswith(SECURE):
                names = self.access or Names()
                settings["access_control"] = access_control({robot: names}, by_user=identity.by_user)
        return settings


def _instead(name: str, endpoint: str) -> str:
    secured = f"tls/{endpoint.partition('/')[2]}"
    if name == "router":
        return f"Write {secured}, with [zenoh.tls]"
    home = f"tcp/127.0.0.1:{endpoint.rpartition(':')[2]}"
    return (
        f"Write {home} for this machine alone; for others {secured}, with [zenoh.tls] and [zenoh.access], or a router"
    )
