"""Emulate the encoders of a robot.toml on one board."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import ClassVar

import msgspec

from bodyschema.drivers.emulator.device import Angle
from bodyschema.drivers.emulator.dry_run import GLITCH_TICKS, DryRunArm
from bodyschema.drivers.emulator.faults import ON_THE_WIRE, FaultKinds, FaultSpec, WireFaults
from bodyschema.drivers.serial_lines.config import EncoderConfig, SerialLinesConfig

from .board import EncoderBoard

KINDS = FaultKinds(ON_THE_WIRE, ("sensor", "glitch"))
BUS = "board"


class EncoderArm(DryRunArm):
    """Encoders as configured, on one board."""

    unit: ClassVar[str] = "lines said"
    kinds = KINDS

    def __init__(
        self,
        config: SerialLinesConfig,
        angles: Mapping[str, Angle],
        *,
        faults: Sequence[FaultSpec] = (),
        seed: int = 0,
        rate_hz: float = 200.0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config, rng = config, Random(seed)
        self._names = {encoder.joint: encoder.name for encoder in config.encoders}
        wire = WireFaults.requested(faults, KINDS, dict.fromkeys(self._names, 0), rng)  # one line contains all encoders
        encoders = {
            encoder.name: (_ticks(encoder), _shaft(encoder, angles[encoder.joint])) for encoder in config.encoders
        }
        self._board = EncoderBoard(encoders, rate_hz=rate_hz, begun_s=now(), boot=rng.randrange(2**16), faults=wire)
        self._board.failing.update(self._names[f.joint] for f in faults if f.kind == "sensor" and f.joint)

    @property
    def devices(self) -> Mapping[str, EncoderBoard]:
        return {BUS: self._board}

    @property
    def count(self) -> int:
        return self._board.lines

    def at_ports(self, ports: Mapping[str, str]) -> SerialLinesConfig:
        return msgspec.structs.replace(self._config, port=ports[BUS])

    def glitch(self, joint: str, is_wrong: bool) -> None:
        self._board.glitch_ticks[self._names[joint]] = GLITCH_TICKS if is_wrong else 0

    def power_cycle(self, t: float) -> None:
        self._board.reboot(t)


def _ticks(encoder: EncoderConfig) -> int:
    return encoder.ticks_per_turn or 4096  # where robot.toml gives none


def _shaft(encoder: EncoderConfig, angle: Angle) -> Angle:
    """Convert the joint's angle to the shaft's angle [rad], which is 0 at the raw position 0."""
    zero = encoder.zero_ticks * 2 * math.pi / _ticks(encoder)
    return lambda t: encoder.direction * angle(t) + zero
