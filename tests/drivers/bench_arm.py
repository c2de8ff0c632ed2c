"""Arms on the bench in virtual time, and what their servos were told."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from random import Random
from typing import Literal

from drivers.bench.faults import Planned
from drivers.bench.virtual_port import VirtualClock, VirtualPort, at_once
from drivers.dynamixel.bench.chain import Chain
from drivers.dynamixel.bench.frames import Code, instructions_in
from drivers.dynamixel.bench.servo import Servo
from drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from drivers.dynamixel.joints import DynamixelJoints
from drivers.dynamixel.models import BY_NAME

TICK = 2 * math.pi / 4096
Path = Callable[[float], float]


def swing(phase: float) -> Path:
    """A joint that is moved by hand, at up to 50°/s."""
    return lambda t: 1.2 * math.sin(0.7 * t + phase)


class HeardPort(VirtualPort):
    """Keeps what is sent."""

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.heard = []

    def write(self, data: bytes) -> None:
        self.heard += instructions_in(bytearray(data))[0]
        super().write(data)

    def writes(self) -> list[tuple[int, bytes]]:
        """Address and data of all that was written to servos."""
        wide = {1: 1, 2: 2}
        told = [i for i in self.heard if i.code in (Code.WRITE, Code.REG_WRITE, Code.SYNC_WRITE, Code.BULK_WRITE)]
        return [(int.from_bytes(i.params[: wide[i.protocol]], "little"), i.params[wide[i.protocol] :]) for i in told]


class Arm:
    """A driver with a bench behind it."""

    def __init__(
        self,
        models: Sequence[str] = ("XM430-W350",) * 3,
        paths: Sequence[Path] | None = None,
        *,
        latency_s: float = 0.0,
        delay_s: float = 0.0,
        seed: int = 0,
        fast: Literal["auto", "never"] = "auto",
        limits: Sequence[tuple[float, float]] | None = None,
        last_pose: Sequence[float] | None = None,
        **settings,
    ) -> None:
        self.clock, rng = VirtualClock(), Random(seed)
        self.paths = [swing(k) for k in range(len(models))] if paths is None else list(paths)
        self.names = tuple(f"joint{k}" for k in range(1, len(models) + 1))
        self.faults = Planned(rng)
        servos = [
            Servo(BY_NAME[model], k, self.paths[k - 1], return_delay_s=delay_s, booted_s=k * 0.1234)
            for k, model in enumerate(models, 1)
        ]
        self.chain = Chain(servos, self.faults)
        jitter = (lambda: rng.uniform(0, latency_s)) if latency_s else at_once
        self.port = HeardPort(self.chain, self.clock, outwards=at_once, inwards=jitter)
        fitted = zip(self.names, models, strict=True)
        entries = tuple(ServoConfig(name, k, model) for k, (name, model) in enumerate(fitted, 1))
        self.config = DynamixelConfig({"arm": BusConfig("bench", fast_sync_read=fast)}, entries, **settings)
        self.joints = DynamixelJoints(
            self.config,
            self.names,
            self.clock,
            limits=limits,
            last_pose=last_pose,
            open_port=lambda *_: (self.port, latency_s / 2),
        )

    def error(self, reading) -> float:
        """Largest error of the reading's angles against the truth at its time [rad]."""
        return max(abs(q - path(reading.t)) for q, path in zip(reading.q, self.paths, strict=True))

    def sampled(self) -> float:
        """The middle of the times at which the positions were really taken [s]."""
        return sum(sampling.t for sampling in self.chain.samplings.values()) / len(self.chain.samplings)
