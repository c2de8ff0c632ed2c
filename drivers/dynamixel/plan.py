"""With which questions all positions of a bus are read, and its servos looked after."""

from __future__ import annotations

from collections.abc import Sequence

from .bus import Bus, Request, read_request, sync_request
from .handshake import FittedServo
from .models import Layout


def block_requests(bus: Bus, servos: Sequence[FittedServo], *, try_fast: bool) -> list[Request]:
    """The questions of one reading: one for all servos of a series of Protocol 2.0, one for each of Protocol 1.0.

    Args:
        try_fast: ask once with FAST_SYNC_READ, and keep to it where all answer.
    """
    requests: list[Request] = []
    groups: dict[int, list[FittedServo]] = {}
    for servo in servos:
        block = servo.model.layout.block
        if servo.model.protocol == 1:
            requests.append(read_request(1, servo.id, block.address, block.size))
        else:
            groups.setdefault(block.address, []).append(servo)
    for group in groups.values():
        requests.append(_group_request(bus, group[0].model.layout, [servo.id for servo in group], try_fast))
    return requests


def _group_request(bus: Bus, layout: Layout, ids: list[int], try_fast: bool) -> Request:
    block = layout.block
    if len(ids) > 1 and try_fast:
        fast = sync_request(ids, block.address, block.size, fast=True)
        if bus.ask(fast).trouble is None:
            return fast
    return sync_request(ids, block.address, block.size, fast=False)


def state_request(servo: FittedServo) -> Request:
    """Ask for torque and hardware error."""
    state = servo.model.layout.state
    return read_request(servo.model.protocol, servo.id, state.address, state.size)


def temperature_request(servo: FittedServo) -> Request:
    """Ask for its temperature [°C], one byte."""
    temperature = servo.model.layout["temperature"]
    return read_request(servo.model.protocol, servo.id, temperature.address, temperature.size)


def torque_and_error(servo: FittedServo, data: bytes, error: int) -> tuple[bool, int]:
    """Whether torque is on, and the bits of the hardware error, of an answer to `state_request`."""
    if servo.model.protocol == 1:
        return data[0] != 0, error
    layout = servo.model.layout
    return data[0] != 0, data[layout["hardware_error"].address - layout.state.address]
