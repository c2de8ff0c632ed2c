"""Report of a program about a body, and the reasons to reject it."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from enum import StrEnum


class Fault(StrEnum):
    """Reason for not using a message."""

    MALFORMED = "malformed"
    NOT_FINITE = "not_finite"
    UNIT = "unit"
    SMALL_UNIT = "small_unit"
    COVARIANCE = "covariance"
    TURN = "turn"
    NO_STAMP = "no_stamp"
    DUPLICATE = "duplicate"
    OUT_OF_ORDER = "out_of_order"
    DELAYED = "delayed"
    LOST = "lost"
    RIVAL = "rival"
    OTHER_BODY = "other_body"
    SEVERAL_BODIES = "several_bodies"
    OTHER_FRAME = "other_frame"
    NOT_TRACKED = "not_tracked"


# What was found, and what to do.
ADVICE: dict[Fault, tuple[str, str]] = {
    Fault.MALFORMED: ("are not what they should be", "compare the sender with docs/marker_sources.md"),
    Fault.NOT_FINITE: ("have a number that is not finite", "let the sender leave such positions out, or send tracked"),
    Fault.UNIT: ("are tens of metres away, as if in millimetres", 'send metres, or write unit = "mm"'),
    Fault.SMALL_UNIT: (
        "are within millimetres of the origin, as if they were in metres",
        'send millimetres, or take out unit = "mm"',
    ),
    Fault.COVARIANCE: (
        "have an invalid covariance, or one that is not in the positions' unit squared",
        'send a symmetric, positive definite matrix in m² (mm² with unit = "mm"), or none',
    ),
    Fault.TURN: ("have a quaternion whose length is not 1", "send x, y, z, w, or none"),
    Fault.NO_STAMP: ("have the stamp 0", "let the sender fill in the time of the measurement"),
    Fault.DUPLICATE: ("came twice", "one program relays them a second time, or the stamp is not the measurement's"),
    Fault.OUT_OF_ORDER: ("came after newer ones", "a network with several routes, or two senders: use one cable"),
    Fault.DELAYED: (
        "came later than their stamps allow",
        "use a cable, send stamps in seconds of one steady clock, or raise max_delay_s",
    ),
    Fault.LOST: ("were lost", "use a cable in the place of Wi-Fi, send less often, or end what loads this machine"),
    Fault.RIVAL: ("came from a second sender", "end one of the two programs, or name the one to use as sender"),
    Fault.OTHER_BODY: ("are of another body", "correct body in [marker_source]"),
    Fault.SEVERAL_BODIES: ("are of several bodies", "name the marker's as body in [marker_source]"),
    Fault.OTHER_FRAME: ("are in another frame", "correct frame in [marker_source], or let one program publish"),
    Fault.NOT_TRACKED: ("say that the marker is not seen", "bring it in sight of more cameras of the source"),
}


class Unusable(Exception):
    """Raised for a message that is not used."""

    def __init__(self, fault: Fault, detail: str = "") -> None:
        self.fault, self.detail = fault, detail
        super().__init__(f"{fault}: {detail}")


@dataclass(frozen=True, slots=True)
class Packet:
    """A message as it arrived."""

    payload: bytes
    sender: Hashable  # identifies the sender
    arrived: float  # time of arrival [s]
    attached: bytes = b""  # attachment of rmw_zenoh; empty without one


@dataclass(frozen=True, slots=True)
class Report:
    """A decoded position, in the sender's unit."""

    x: tuple[float, ...] | None  # position, 3 numbers; None where the body is not tracked
    stamp_ns: int | None = None  # time on the sender's clock [ns]; None without one
    age_s: float = 0.0  # age of the measurement at its stamp, by the sender's own clock [s]
    seq: int | None = None  # number of the message among all of its sender, for counting lost ones
    turn: tuple[float, ...] | None = None  # quaternion (x, y, z, w), or None
    cov: tuple[float, ...] | None = None  # 9 numbers by rows, or 36 with the rotation's; or None
    spread: float = 0.0  # 1-sigma that the sender estimates for this position, in its unit
    # body, frame: names, where there are any
    body: str | None = None
    frame: str | None = None
    where: tuple[str, ...] = ()  # the names by which robot.toml may call the body
