"""Faults as a user asks for them: `late`, `late=0.1`, `mute@elbow`, `overload@elbow`, `unplug`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from random import Random
from types import MappingProxyType

from drivers.bench.device import Fault, Reply
from drivers.bench.faults import corrupt, garbage, half, late, mute, wrong_checksum
from interfaces.errors import ConfigError
from interfaces.suggest import did_you_mean

from .faults import swapped

ON_THE_WIRE: MappingProxyType[str, Fault] = MappingProxyType(
    {
        "mute": mute,
        "late": late(0.05),
        "checksum": wrong_checksum,
        "corrupt": corrupt(),
        "half": half,
        "garbage": garbage(),
        "swapped": swapped,
    }
)
# Bits of Hardware Error Status.
OF_A_SERVO: MappingProxyType[str, int] = MappingProxyType(
    {"voltage": 0x01, "hot": 0x04, "encoder": 0x08, "shock": 0x10, "overload": 0x20}
)
# What is another way from the beginning.
AT_THE_START = ("baud", "double", "torque")
# What happens again and again.
NOW_AND_THEN = ("glitch", "power-cycle", "unplug")
KINDS = (*ON_THE_WIRE, *OF_A_SERVO, *AT_THE_START, *NOW_AND_THEN)
OF_ONE_JOINT = (*OF_A_SERVO, *AT_THE_START, "glitch")
SHARE = 0.02
OPTION = "--fault"


@dataclass(frozen=True, slots=True)
class AskedFault:
    """One fault.

    Attributes:
        kind: one of KINDS.
        joint: whose servo; None: all.
        share: the probability that an answer suffers it, for those on the wire.
    """

    kind: str
    joint: str | None
    share: float

    @classmethod
    def parsed(cls, text: str, joints: Collection[str]) -> AskedFault:
        """The fault that `KIND[@JOINT][=SHARE]` names.

        With a joint every answer of its servo suffers a fault on the wire, without one 2 % of all answers do.

        Raises:
            ConfigError: there is no such kind or joint, or the share is no probability.
        """
        named, _, share = text.partition("=")
        kind, _, joint = named.partition("@")
        if kind not in KINDS:
            raise ConfigError(f"{OPTION} {text}: unknown fault {kind!r}", remedy=did_you_mean(kind, KINDS))
        if joint and joint not in joints:
            raise ConfigError(f"{OPTION} {text}: unknown joint {joint!r}", remedy=did_you_mean(joint, joints))
        if not joint and kind in OF_ONE_JOINT:
            first = next(iter(joints))
            raise ConfigError(f"{OPTION} {text}: it is of one joint", remedy=f"Name it, as in {kind}@{first}")
        if joint and kind in ("unplug", "power-cycle"):
            raise ConfigError(f"{OPTION} {text}: it strikes all servos", remedy=f"Give {kind} alone")
        if share and kind not in ON_THE_WIRE:
            raise ConfigError(f"{OPTION} {text}: it has no share", remedy=f"Give {named} alone")
        return cls(kind, joint or None, _probability(text, share) if share else 1.0 if joint else SHARE)


def _probability(text: str, share: str) -> float:
    try:
        value = float(share)
    except ValueError:
        value = -1.0
    if not 0.0 < value <= 1.0:
        raise ConfigError(f"{OPTION} {text}: {share!r} is no share", remedy="Give one between 0 and 1, as in late=0.05")
    return value


class WireFaults:
    """What happens to the answers on one bus."""

    def __init__(self, faults: Sequence[tuple[int | None, float, Fault]], rng: Random) -> None:
        """Faults with the ID that each strikes (None: all) and its probability."""
        self._faults, self._rng = tuple(faults), rng

    def __call__(self, reply: Reply) -> Reply:
        """The answer as it arrives."""
        for id, share, fault in self._faults:
            if reply.data and id in (None, reply.id) and self._rng.random() < share:
                reply = fault(reply, self._rng)
        return reply
