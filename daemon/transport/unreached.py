"""Explain why a process could not be reached, and what to do."""

from __future__ import annotations

import socket

from .identity import Route

ACCEPT_LIMIT_S = 1.0


def unreached(route: Route) -> str:
    """Return the reason why none of a route's endpoints could be reached."""
    last = route.endpoints[-1]
    if not _accepts(last):
        return (
            f"nothing listens on {route}. Start the daemon with `bodyschema run`, "
            "or fix the table [zenoh] of robot.toml"
        )
    if route.secured:
        return (
            f"{last} is there, but the connection was refused: your certificate or password is not accepted there, "
            "or its certificate is not for that name or not of your authority. docs/security.md shows how to look"
        )
    return (
        f"somebody listens on {last} but does not answer: it is stopped, very busy, or no bodyschema. "
        "`ps` shows what it is"
    )


def _accepts(endpoint: str) -> bool:
    """Return True if a TCP endpoint accepts connections, even from a process that never answers."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls") or not port.isdigit():
        return False
    try:
        with socket.create_connection((host.strip("[]"), int(port)), ACCEPT_LIMIT_S):
            return True
    except OSError:
        return False
