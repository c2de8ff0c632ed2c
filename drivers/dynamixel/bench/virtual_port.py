"""See `drivers.bench.virtual_port`."""

from __future__ import annotations

from drivers.bench.virtual_port import VirtualClock, VirtualPort, at_once

__all__ = ["VirtualClock", "VirtualPort", "at_once"]
