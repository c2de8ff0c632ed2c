"""The encoders that a robot.toml describes, on a board on a bench."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import ClassVar

import msgspec

from bodyschema.drivers.bench.asked_faults import ON_THE_WIRE, AskedFault, FaultKinds, WireFaults
from bodyschema.drivers.bench.dry_run import Angle, BenchArm
from bodyschema.drivers.serial_lines.config import EncoderConfig, SerialLinesConfig

from .board import EncoderBoard

KINDS = FaultKinds(ON_THE_WIRE, ("sensor", "glitch"))
BUS = "board"
TICKS_PER_TURN = 4096  # where robot.toml does not say
GLITCH_TICKS = 700
RATE_HZ = 200.0


class EncoderArm(BenchArm):
    """Encoders as they are configured, on one board."""

    unit: ClassVar[str] = "lines said"

    def __init__(
        self,
        config: SerialLinesConfig,
        angles: Mapping[str, Angle],
        *,
        faults: Sequence[AskedFault] = (),
        seed: int = 0,
        rate_hz: float = RATE_HZ,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """A board with its power on.

        Args:
            config: checked.
            angles: by joint, its angle at a time [rad].
            seed: of the faults on the wire.
        """
        self._config, rng = config, Random(seed)
        self._names = {encoder.joint: encoder.name for encoder in config.encoders}
        wire = WireFaults.asked(faults, KINDS, dict.fromkeys(self._names, 0), rng)  # one line tells of all
        encoders = {
            encoder.name: (_ticks(encoder), _shaft(encoder, angles[encoder.joint])) for encoder in config.encoders
        }
        self._board = EncoderBoard(encoders, rate_hz=rate_hz, begun_s=now(), boot=rng.randrange(2**16), faults=wire)
        self._board.failing.update(self._names[f.joint] for f in faults if f.kind == "sensor" and f.joint)

    @property
    def devices(self) -> Mapping[str, EncoderBoard]:
        """What is behind the port."""
        return {BUS: self._board}

    @property
    def count(self) -> int:
        """How many lines were said."""
        return self._board.lines

    def at_ports(self, ports: Mapping[str, str]) -> SerialLinesConfig:
        """The configuration with another port."""
        return msgspec.structs.replace(self._config, port=ports[BUS])

    def glitch(self, joint: str, is_wrong: bool) -> None:
        """A joint's encoder begins or ends to be wrong."""
        self._board.glitch_ticks[self._names[joint]] = GLITCH_TICKS if is_wrong else 0

    def power_cycle(self, t: float) -> None:
        """The board loses its power and has it back at `t`."""
        self._board.reboot(t)


def _ticks(encoder: EncoderConfig) -> int:
    return encoder.ticks_per_turn or TICKS_PER_TURN


def _shaft(encoder: EncoderConfig, angle: Angle) -> Angle:
    """The shaft's angle [rad], which is 0 at the raw position 0, from that of the joint."""
    zero = encoder.zero_ticks * 2 * math.pi / _ticks(encoder)
    return lambda t: encoder.direction * angle(t) + zero
