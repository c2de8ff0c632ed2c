"""Properties of a servo vendor that the common driver needs."""

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
    """A servo vendor.

    Attributes:
        table: its table in robot.toml.
        models: by number.
        errors: meaning and remedy of each bit of the hardware error.
        bus: class of its buses.
        channel: creates the decoder of one servo's answers.
        ways: returns the read methods of each group of servos on a bus, the fastest first.
        settings: returns the EEPROM settings of a model that a command may change.
        homing_sign: 1 where the homing offset is added to the sensor's value, −1 where it is subtracted.
        tick_s: tick of the clock with which servos stamp their measurements [s]; 0 without one.
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
