"""Select the read methods for Dynamixel servos."""

from __future__ import annotations

from collections.abc import Sequence

from bodyschema.drivers.servos.bus import Bus
from bodyschema.drivers.servos.handshake import FittedServo
from bodyschema.drivers.servos.model import Layout
from bodyschema.drivers.servos.plan import Way

from .bus import sync_request
from .config import BusConfig


def ways_of(bus: Bus, servos: Sequence[FittedServo], config: BusConfig) -> list[list[Way]]:
    """Return the read methods of each group: Protocol 1.0 as one, and each series of Protocol 2.0."""
    alone = [servo for servo in servos if servo.model.protocol == 1]
    series: dict[int, list[FittedServo]] = {}
    for servo in servos:
        if servo.model.protocol == 2:
            series.setdefault(servo.model.layout.block.address, []).append(servo)
    groups = [
        _ways_of_series(group[0].model.layout, [servo.id for servo in group], try_fast=config.fast_sync_read == "auto")
        for group in series.values()
    ]
    if alone:
        requests = (bus.read_request(servo.model, servo.id, servo.model.layout.block) for servo in alone)
        groups.insert(0, [Way("one by one", tuple(requests))])
    return groups


def _ways_of_series(layout: Layout, ids: Sequence[int], *, try_fast: bool) -> list[Way]:
    sync = Way("Sync Read", (sync_request(layout, ids, fast=False),))
    if len(ids) < 2 or not try_fast:
        return [sync]
    return [Way("Fast Sync Read", (sync_request(layout, ids, fast=True),)), sync]
