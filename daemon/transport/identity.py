"""Credentials of a machine and its requirements for connecting clients: TLS, certificates, passwords."""

from __future__ import annotations

import ipaddress
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.limited import read_at_most

SECURE = ("tls", "quic")
READ_BY_OTHERS = stat.S_IROTH


class TlsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table `tls`; PEM files, relative to the file that names them."""

    ca: str  # certificate of the authority that signed all certificates
    # certificate, key: those of this machine or person; needed to listen, and to connect without a password
    certificate: str | None = None
    key: str | None = None


class LoginConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table `login`: name and password instead of a client certificate."""

    user: str  # name
    password_file: str  # its first line is the password; relative to the file that names it


@dataclass(frozen=True)
class Identity:
    """Credentials of this machine, and how it identifies others."""

    ca: Path
    certificate: Path | None = None
    key: Path | None = None
    user: str | None = None
    password_file: Path | None = None
    users_file: Path | None = None  # a line `user:password` for each permitted user; None: clients present certificates

    @classmethod
    def of(cls, tls: TlsConfig, login: LoginConfig | None, users_file: str | None, folder: Path) -> Identity:
        """Read the tables of a file in `folder`.

        Raises:
            ConfigError: a certificate lacks its key, a file is missing, or a secret is readable by other users.
        """
        if (tls.certificate is None) != (tls.key is None):
            raise ConfigError("tls names a certificate or a key", remedy="Name both: each is useless alone")
        secret = (tls.key, None if login is None else login.password_file, users_file)
        for name in (tls.ca, tls.certificate, *secret):
            if name is not None:
                _check_file(folder / name, secret=name in secret)

        def found(name: str | None) -> Path | None:
            return None if name is None else (folder / name).absolute()

        return cls(
            ca=(folder / tls.ca).absolute(),
            certificate=found(tls.certificate),
            key=found(tls.key),
            user=None if login is None else login.user,
            password_file=None if login is None else found(login.password_file),
            users_file=found(users_file),
        )

    @property
    def files(self) -> tuple[Path, ...]:
        named = (self.ca, self.certificate, self.key, self.password_file, self.users_file)
        return tuple(path for path in named if path is not None)

    @property
    def by_user(self) -> bool:
        """True if clients authenticate with passwords instead of certificates."""
        return self.users_file is not None

    def settings(self) -> dict[str, Any]:
        """Return zenoh's configuration of links and users; raise ConfigError if the password cannot be read."""
        tls: dict[str, Any] = {
            "root_ca_certificate": str(self.ca),
            "enable_mtls": self.certificate is not None and not self.by_user,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
        if self.certificate is not None:
            tls |= {
                f"{end}_{part}": str(file)
                for end in ("listen", "connect")
                for part, file in (("certificate", self.certificate), ("private_key", self.key))
            }
        users: dict[str, Any] = {}
        if self.user is not None and self.password_file is not None:
            users |= {"user": self.user, "password": _first_line(self.password_file)}
        if self.users_file is not None:
            users["dictionary_file"] = str(self.users_file)
        return {"transport/link/tls": tls, **({"transport/auth/usrpwd": users} if users else {})}


@dataclass(frozen=True)
class Route:
    """Endpoints of a process, and the credentials to use."""

    endpoints: tuple[str, ...]  # tried in this order
    identity: Identity | None = None

    @property
    def secured(self) -> bool:
        """True if the last endpoint requires authentication."""
        return self.endpoints[-1].startswith(SECURE)

    def __str__(self) -> str:
        return " or ".join(self.endpoints)


def is_local(endpoint: str) -> bool:
    """Return True if only this machine can reach the endpoint."""
    if endpoint.startswith("unixsock-stream/"):
        return True
    host = (
        endpoint.partition("/")[2].partition("?")[0].partition("#")[0].rpartition(":")[0].strip("[]")
    )  # IPv6 has them
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _check_file(file: Path, *, secret: bool) -> None:
    try:
        mode = file.stat().st_mode
        read_at_most(file)
    except OSError as error:
        remedy = "docs/security.md shows how certificates are made"
        raise ConfigError(f"{file} cannot be read: {error.strerror}", remedy=remedy) from error
    if secret and mode & READ_BY_OTHERS:
        raise ConfigError(f"{file} is secret, and every user of this machine can read it", remedy=f"chmod 600 {file}")


def _first_line(file: Path) -> str:
    try:
        lines = read_at_most(file).decode().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError("the password cannot be read", file=file, remedy="Write it in the first line") from error
    if not lines or not lines[0]:
        raise ConfigError("the password is empty", file=file, remedy="Write it in the first line")
    return lines[0]
