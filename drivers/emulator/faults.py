"""Faults of an answer in transit, as requested on the command line: `late=0.1`, `mute@elbow`, `unplug`.

Faults of a servo are set on the servo.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.suggest import did_you_mean

from .device import Fault, Reply


def mute(reply: Reply, rng: Random) -> Reply:
    """Drop the answer."""
    del rng
    return replace(reply, data=b"")


def late(longest_s: float) -> Fault:
    """Return a fault that delays an answer by up to `longest_s`."""
    return lambda reply, rng: replace(reply, start=reply.start + rng.uniform(0.0, longest_s))


def wrong_checksum(reply: Reply, rng: Random) -> Reply:
    """Flip one bit of the checksum."""
    return replace(reply, data=reply.data[:-1] + bytes((reply.data[-1] ^ 1 << rng.randrange(8),)))


def corrupt(most_bytes: int = 4) -> Fault:
    """Return a fault that changes up to `most_bytes` bytes."""

    def fault(reply: Reply, rng: Random) -> Reply:
        data = bytearray(reply.data)
        for _ in range(rng.randint(1, most_bytes)):
            data[rng.randrange(len(data))] ^= rng.randint(1, 255)
        return replace(reply, data=bytes(data))

    return fault


def half(reply: Reply, rng: Random) -> Reply:
    """Truncate the answer."""
    return replace(reply, data=reply.data[: rng.randrange(1, len(reply.data))])


def garbage(reply: Reply, rng: Random) -> Reply:
    """Put up to twelve random bytes before or after the answer."""
    noise = rng.randbytes(rng.randint(1, 12))
    return replace(reply, data=noise + reply.data if rng.random() < 0.5 else reply.data + noise)


ON_THE_WIRE: Mapping[str, Fault] = {
    "mute": mute,
    "late": late(0.05),
    "checksum": wrong_checksum,
    "corrupt": corrupt(),
    "half": half,
    "garbage": garbage,
}
OF_ALL = ("power-cycle", "unplug")
NOW_AND_THEN = ("glitch", *OF_ALL)
OPTION = "--fault"


@dataclass(frozen=True, slots=True)
class FaultKinds:
    """Faults available for a vendor's servos or encoders."""

    on_the_wire: Mapping[str, Fault]  # faults of transmitted packets, by name
    # faults of one servo or encoder; `glitch` recurs, the others are present from the start
    of_one_joint: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.on_the_wire, *self.of_one_joint, *OF_ALL)


@dataclass(frozen=True, slots=True)
class FaultSpec:
    kind: str  # its name
    joint: str | None  # joint whose servo or encoder is affected; None: all
    share: float  # the probability that an answer is affected, for faults on the wire

    @classmethod
    def parsed(cls, text: str, joints: Collection[str], kinds: FaultKinds, usual_share: float = 0.02) -> FaultSpec:
        """Parse `KIND[@JOINT][=SHARE]`.

        A wire fault with a joint affects every answer of its servo; without a joint it affects 2 % of all answers.

        Raises:
            ConfigError: an unknown kind or joint, or a share.
        """
        named, _, share = text.partition("=")
        kind, _, joint = named.partition("@")
        if kind not in kinds.names:
            raise ConfigError(f"{OPTION} {text}: unknown fault {kind!r}", remedy=did_you_mean(kind, kinds.names))
        if joint and joint not in joints:
            raise ConfigError(f"{OPTION} {text}: unknown joint {joint!r}", remedy=did_you_mean(joint, joints))
        if not joint and kind in kinds.of_one_joint:
            first = next(iter(joints))
            raise ConfigError(f"{OPTION} {text}: it is of one joint", remedy=f"Name it, as in {kind}@{first}")
        if joint and kind in OF_ALL:
            raise ConfigError(f"{OPTION} {text}: it strikes all servos", remedy=f"Give {kind} alone")
        if share and kind not in kinds.on_the_wire:
            raise ConfigError(f"{OPTION} {text}: it has no share", remedy=f"Give {named} alone")
        return cls(kind, joint or None, _probability(text, share) if share else 1.0 if joint else usual_share)


def _probability(text: str, share: str) -> float:
    try:
        value = float(share)
    except ValueError:
        value = -1.0
    if not 0.0 < value <= 1.0:
        raise ConfigError(f"{OPTION} {text}: {share!r} is no share", remedy="Give one between 0 and 1, as in late=0.05")
    return value


class WireFaults:
    """Faults of the packets on one bus."""

    def __init__(self, faults: Sequence[tuple[int | None, float, Fault]], rng: Random) -> None:
        """Store triples of servo ID (None: all), probability and fault."""
        self._faults, self._rng = tuple(faults), rng

    @classmethod
    def requested(
        cls, faults: Sequence[FaultSpec], kinds: FaultKinds, ids: Mapping[str, int], rng: Random
    ) -> WireFaults:
        """Select those of `faults` that affect a bus; `ids` maps the joints on it to servo IDs."""
        here = [f for f in faults if f.kind in kinds.on_the_wire and (f.joint is None or f.joint in ids)]
        strike = [(None if f.joint is None else ids[f.joint], f.share, kinds.on_the_wire[f.kind]) for f in here]
        return cls(strike, Random(rng.random()))

    def __call__(self, reply: Reply) -> Reply:
        for id, share, fault in self._faults:
            if reply.data and id in (None, reply.id) and self._rng.random() < share:
                reply = fault(reply, self._rng)
        return reply
