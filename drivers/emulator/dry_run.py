"""Emulate the arm of a robot.toml on pseudo-terminals."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar, Self

from .device import Device
from .faults import NOW_AND_THEN, FaultSpec
from .pty_shell import PtyShell


class _Settings:
    every_s: float = 10.0  # period of recurring faults
    unplugged_s: float = 3.0  # how long a port is gone
    glitch_s: float = 0.1  # how long an encoder is wrong


GLITCH_TICKS = 700  # by which an encoder is wrong

Event = tuple[float, str, Callable[[], None]]


class DryRunArm(ABC):
    """The devices behind the ports of an emulated arm.

    Attributes:
        unit: the unit of `count`, in the plural.
    """

    unit: ClassVar[str]

    @property
    @abstractmethod
    def devices(self) -> Mapping[str, Device]:
        """Device behind each port, by name of the bus."""

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of packets understood, or lines sent, so far."""

    @abstractmethod
    def at_ports(self, ports: Mapping[str, str]) -> Any:
        """Return the configuration with other ports, given by name of the bus."""

    @abstractmethod
    def glitch(self, joint: str, is_wrong: bool) -> None:
        """Start or end an encoder error of one joint."""

    @abstractmethod
    def power_cycle(self, t: float) -> None:
        """Cut the power of the whole arm and restore it at `t`."""


class DryRun:
    """An emulated arm as configured, each bus behind its own port. A context manager.

    Attributes:
        config: the configuration with its ports replaced by the emulator's.
        shells: pseudo-terminals, by name of the bus.
    """

    def __init__(self, arm: DryRunArm, links: Mapping[str, Path], *, faults: Sequence[FaultSpec] = ()) -> None:
        """Prepare the ports without opening them.

        Args:
            links: by bus, the path of its port.
            faults: the recurring ones are played here; all others belong to the arm.
        """
        self.arm, self._faults = arm, tuple(faults)
        self._opened = ExitStack()
        self.shells = {name: PtyShell(device, links[name]) for name, device in arm.devices.items()}
        self.config = arm.at_ports({name: str(link) for name, link in links.items()})

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for shell in self.shells.values():
                stack.enter_context(shell)
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def events(self) -> Iterator[Event]:
        """Yield the requested recurring events: delay [s], description, and the function that triggers it."""
        requested = [fault for fault in self._faults if fault.kind in NOW_AND_THEN]
        while requested:
            for fault in requested:
                yield from self._happening(fault)

    def _happening(self, fault: FaultSpec) -> Iterator[Event]:
        joint = fault.joint or ""
        if fault.kind == "unplug":
            yield _Settings.every_s, "unplugged", lambda: self._each(PtyShell.unplug)
            yield _Settings.unplugged_s, "plugged in again", lambda: self._each(PtyShell.plug_in)
        elif fault.kind == "power-cycle":
            yield _Settings.every_s, "the power is lost and comes back", lambda: self.arm.power_cycle(time.monotonic())
        else:
            yield (
                _Settings.every_s,
                f"the encoder of {joint} is wrong for a moment",
                lambda: self.arm.glitch(joint, True),
            )
            yield _Settings.glitch_s, f"the encoder of {joint} is right again", lambda: self.arm.glitch(joint, False)

    def _each(self, act: Callable[[PtyShell], None]) -> None:
        for shell in self.shells.values():
            act(shell)
