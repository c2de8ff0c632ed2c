"""Joint states that a node, or the way from it, corrupts."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from random import Random

from bodyschema.drivers.ros2.messages import NANO, Header, JointState, encode_joint_state


class Fault(StrEnum):
    """A way to corrupt a message."""

    GARBAGE = "garbage"  # random bytes
    TRUNCATED = "truncated"
    BIT = "bit"  # one bit is flipped
    WORD = "word"  # four bytes become a large number, possibly in place of a length
    SWAPPED_NAMES = "swapped_names"
    MISSING_JOINT = "missing_joint"
    NAN = "nan"
    REPEATED = "repeated"  # the stamp of the previous message
    CLOCK_JUMP = "clock_jump"  # the stamp is seconds off
    SILENCE = "silence"  # it is not sent


# Faults of the content of a well-formed message. They do not show in the encoding.
OF_THE_NODE = (Fault.SWAPPED_NAMES, Fault.MISSING_JOINT, Fault.NAN, Fault.REPEATED, Fault.CLOCK_JUMP)


def spoilt(fault: Fault, message: JointState, before_ns: int, rng: Random) -> bytes | None:
    """Encode a message with a fault; return None for silence."""
    if fault is Fault.SILENCE:
        return None
    if fault in OF_THE_NODE:
        return encode_joint_state(_misled(fault, message, before_ns, rng))
    data = bytearray(encode_joint_state(message))
    if fault is Fault.GARBAGE:
        return rng.randbytes(rng.randrange(2 * len(data)))
    if fault is Fault.TRUNCATED:
        return bytes(data[: rng.randrange(len(data))])
    if fault is Fault.BIT:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    else:
        at = 4 * rng.randrange(1, len(data) // 4)
        data[at : at + 4] = rng.choice((2**32 - 1, 2**31, 10**6)).to_bytes(4, "little")
    return bytes(data)


def _misled(fault: Fault, message: JointState, before_ns: int, rng: Random) -> JointState:
    names, positions = list(message.names), list(message.positions)
    if fault is Fault.SWAPPED_NAMES and len(names) > 1:
        one, other = rng.sample(range(len(names)), 2)
        names[one], names[other] = names[other], names[one]
        return replace(message, names=tuple(names))
    if fault is Fault.MISSING_JOINT:
        gone = rng.randrange(len(names))
        del names[gone], positions[gone]
        return JointState(message.header, tuple(names), tuple(positions))
    if fault is Fault.NAN:
        positions[rng.randrange(len(positions))] = float("nan")
        return replace(message, positions=tuple(positions))
    jump_ns = rng.choice((-1, 1)) * rng.randrange(1, 100) * NANO
    stamp_ns = before_ns if fault is Fault.REPEATED else message.header.stamp_ns + jump_ns
    return replace(message, header=Header(stamp_ns, message.header.frame))


class Planned:
    """Encoder that corrupts the next message on request, or a random share of all."""

    def __init__(self, rng: Random, *, share: float = 0.0, kinds: tuple[Fault, ...] = tuple(Fault)) -> None:
        self._rng, self._share, self._kinds = rng, share, kinds
        self._before_ns = 0
        self.next: Fault | None = None  # fault of the next message; reset to None once it is applied
        self.given: dict[Fault, int] = {}

    def __call__(self, message: JointState) -> bytes | None:
        """Encode the message, corrupted or not."""
        fault, self.next = self.next, None
        if fault is None and self._rng.random() < self._share:
            fault = self._rng.choice(self._kinds)
        before_ns, self._before_ns = self._before_ns, message.header.stamp_ns
        if fault is None:
            return encode_joint_state(message)
        self.given[fault] = self.given.get(fault, 0) + 1
        return spoilt(fault, message, before_ns, self._rng)
