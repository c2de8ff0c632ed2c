"""Run emulated servos until asked to stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import Self

from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.emulators import (
    Motion,
    emulate_commands,
    emulated_motion,
    emulated_ports,
    emulator_robot_file,
    open_emulator,
)

FAULTS: Mapping[str, str] = MappingProxyType(
    {
        "mute": "an answer is not sent (2 % of all; with @JOINT every one of that servo; or =SHARE)",
        "late": "an answer comes up to 50 ms late",
        "checksum": "a bit of its checksum is wrong",
        "corrupt": "some of its bytes are others",
        "half": "it breaks off",
        "garbage": "random bytes come before or after it",
        "swapped": "it carries a neighbour's ID",
        "voltage": "@JOINT: the supply is out of range, and the servo says so",
        "hot": "@JOINT: it is too hot",
        "encoder": "@JOINT: its motor's encoder fails",
        "shock": "@JOINT: its circuit is damaged (Dynamixel)",
        "current": "@JOINT: its motor draws too much current (Feetech)",
        "overload": "@JOINT: it is overloaded",
        "baud": "@JOINT: it listens at another rate",
        "sensor": "@JOINT: its sensor has no value (own encoders)",
        "double": "@JOINT: a second servo has the same ID",
        "torque": "@JOINT: its torque is on",
        "glitch": "@JOINT: every 10 s its encoder is wrong for a moment",
        "power-cycle": "every 10 s the power is lost and comes back",
        "unplug": "every 10 s the port is gone for 3 s",
    }
)


class EmulatorRun:
    """The emulated servos of a robot.toml behind a port, with a robot.toml that names this port."""

    def __init__(
        self,
        config: Config,
        port: Path,
        *,
        faults: Sequence[str] = (),
        return_delay_s: float = 0.0,
        seed: int = 0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Store the settings; nothing is created yet.

        Raises:
            ConfigError: robot.toml has no servos, a fault does not exist, or the port's name is taken.
        """
        self._config, self._port, self._now = config, port, now
        self._motion = Motion(dict.fromkeys(config.robot.joints, _still), "standing still")
        self._make = lambda motion: open_emulator(
            config, port, motion, faults=faults, return_delay_s=return_delay_s, seed=seed
        )
        self._emulator = self._make(self._motion)
        self._events = self._emulator.events()
        self._next: tuple[float, str, Callable[[], None]] | None = None
        self._opened = ExitStack()
        self.robot_file = port.with_name(f"{port.name}.toml")
        self.stopping = False

    def prepare(self, tell: Callable[[float], None]) -> None:
        """Compute the motion; `tell` is called with the completed share."""
        self._motion = emulated_motion(self._config, tell)
        self._emulator = self._make(self._motion)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(self._emulator)
            file = emulator_robot_file(self._config, self._emulator, self._port)
            stack.callback(file.unlink, missing_ok=True)
            self._opened = stack.pop_all()
        self._events = self._emulator.events()
        self._plan_next(self._now())
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    @property
    def count(self) -> int:
        """Number of packets understood, or of lines sent."""
        return self._emulator.arm.count

    @property
    def unit(self) -> str:
        """Unit of `count`."""
        return self._emulator.arm.unit

    def stop(self) -> None:
        """Request the end. Only sets a flag: a signal handler may call it."""
        self.stopping = True

    def due(self) -> Iterator[str]:
        """Perform the actions that are due, and yield a message for each."""
        while self._next is not None and self._now() >= self._next[0]:
            at, message, act = self._next
            act()
            self._plan_next(at)
            yield message

    def introduction(self) -> Iterator[str]:
        """Yield a description of the emulation, and the commands to type in another terminal."""
        config, file = self._config, self.robot_file
        for words in emulated_ports(self._emulator):
            yield f"{config.robot.name}: {words}"
        yield self._motion.words
        yield "In another terminal:"
        for command in emulate_commands(self._emulator):
            yield f"  bodyschema {command} --robot {file}"
        yield f"{file} is {config.file} with the emulator's port. Ctrl-C ends the emulator."

    def _plan_next(self, after: float) -> None:
        event = next(self._events, None)
        self._next = None if event is None else (after + event[0], event[1], event[2])


def _still(_t: float) -> float:
    return 0.0
