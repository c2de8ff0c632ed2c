"""Arms of emulated servos of any vendor in virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

from virtual_port import VirtualClock, VirtualPort, at_once
from wire_faults import Planned

from bodyschema.drivers.emulator.chain import ServoChain
from bodyschema.drivers.servos.config import ServosConfig
from bodyschema.drivers.servos.joints import ServoJoints

TICK = 2 * math.pi / 4096
Path = Callable[[float], float]


def swing(phase: float) -> Path:
    """Return the path of a joint moved by hand, at up to 50°/s."""
    return lambda t: 1.2 * math.sin(0.7 * t + phase)


class ServoArm:
    """A driver connected to an emulator.

    Args:
        servo: makes one of a model's name, an ID and its path.
        port: a class of ports, which may keep what is sent.
        held_s: largest delay of a request.
    """

    joints: ServoJoints

    def __init__(
        self,
        models: Sequence[str],
        paths: Sequence[Path] | None,
        *,
        servo: Callable[[str, int, Path], Any],
        chain: Callable[..., ServoChain[Any]],
        port: type[VirtualPort],
        latency_s: float,
        seed: int,
        held_s: float = 0.0,
    ) -> None:
        self.clock, rng = VirtualClock(), Random(seed)
        self.paths = [swing(k) for k in range(len(models))] if paths is None else list(paths)
        self.names = tuple(f"joint{k}" for k in range(1, len(models) + 1))
        self.faults = Planned(rng)
        servos = [servo(model, k, self.paths[k - 1]) for k, model in enumerate(models, 1)]
        self.chain: Any = chain(servos, self.faults)
        jitter = (lambda: rng.uniform(0, latency_s)) if latency_s else at_once
        held = (lambda: rng.uniform(0, held_s)) if held_s else at_once
        self.port: Any = port(self.chain, self.clock, outwards=held, inwards=jitter)
        self._latency_s, self._models = latency_s, models

    def entries(self, kind: Callable[[str, int, str], Any]) -> tuple[Any, ...]:
        """Return the servos as entries of robot.toml."""
        fitted = zip(self.names, self._models, strict=True)
        return tuple(kind(name, k, model) for k, (name, model) in enumerate(fitted, 1))

    def driven(self, driver: Callable[..., ServoJoints], config: ServosConfig[Any], **settings: Any) -> None:
        """Put `driver` before the emulator."""
        opened = self.port, self._latency_s / 2
        self.joints = driver(config, self.names, self.clock, open_port=lambda *_: opened, **settings)

    def error(self, reading) -> float:
        """Return the largest error of the reading's angles against the truth at its time [rad]."""
        return max(abs(q - path(reading.t)) for q, path in zip(reading.q, self.paths, strict=True))

    def sampled(self) -> float:
        """Return the mean time at which the positions were really sampled [s]."""
        return sum(sampling.t for sampling in self.chain.samplings.values()) / len(self.chain.samplings)
