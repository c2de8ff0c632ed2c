"""A make of servos: all that the common driver has to know of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from .bus import Bus
from .channel import Channel
from .handshake import FittedServo
from .model import Model
from .plan import Way
from .settings import Setting


@dataclass(frozen=True, slots=True)
class Make:
    """A make of servos.

    Attributes:
        table: its table in robot.toml.
        models: by number.
        errors: what each bit of the hardware error means, and what to do.
        bus: a bus of its protocols.
        channel: one servo's answers.
        ways: of each group of servos of a bus, how it can be read, the quickest first.
        settings: what a command may change in a model's EEPROM.
        homing_sign: 1 where the homing offset is added to what the sensor tells, −1 where it is taken off.
        tick_s: of the clock with which its servos stamp what they measure [s]; 0 without one.
    """

    table: str
    models: Mapping[int, Model] = field(repr=False)
    errors: Mapping[int, str]
    bus: type[Bus]
    channel: Callable[[FittedServo], Channel]
    ways: Callable[[Bus, Sequence[FittedServo], Any], Sequence[Sequence[Way]]]
    settings: Callable[[Model], Sequence[Setting]]
    homing_sign: Literal[1, -1]
    tick_s: float = 0.0
