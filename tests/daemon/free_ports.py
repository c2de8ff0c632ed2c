"""Ports for the processes of tests."""

from __future__ import annotations

import random
import socket
from collections.abc import Iterator
from contextlib import suppress

# Below the ports that Linux gives to outgoing connections (ip_local_port_range), so that none is taken meanwhile.
_RANGE = range(20_000, 32_000)


def _ports() -> Iterator[int]:
    while True:
        # Not seeded: other workers and other runs of the tests on this machine shall draw others.
        yield from random.SystemRandom().sample(_RANGE, len(_RANGE))


_drawn = _ports()


def free_endpoint() -> str:
    """Return an unused zenoh endpoint on this machine, a different one at each call."""
    for port in _drawn:
        with suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return f"tcp/127.0.0.1:{port}"
    raise AssertionError("ports are drawn for ever")
