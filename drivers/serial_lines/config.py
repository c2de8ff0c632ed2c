"""The table [drivers.serial_lines] of robot.toml."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from bodyschema.drivers.servos.config import require_each
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.suggest import did_you_mean
from bodyschema.robot.toml_file import NonNegative, line_in_entry

TABLE = "drivers.serial_lines"


class EncoderConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An entry [[drivers.serial_lines.encoders]]: the encoder of one joint."""

    joint: str  # its name in [robot] joints
    encoder: str | None = None  # its name in the board's header; by default the joint's
    direction: Literal[1, -1] = 1  # −1 where the joint counts against the encoder
    zero_ticks: int = 0  # the encoder's position where the joint is at 0
    # value expected in the header; without this key the header's value is used
    ticks_per_turn: Annotated[int, Meta(gt=1)] | None = None

    @property
    def name(self) -> str:
        """The encoder's name in the header."""
        return self.joint if self.encoder is None else self.encoder


class SerialLinesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers.serial_lines]."""

    port: str  # best one of /dev/serial/by-id, which stays the same when it is plugged in again
    encoders: Annotated[tuple[EncoderConfig, ...], Meta(min_length=1)]  # one for each joint
    baud: Annotated[int, Meta(ge=9600, le=4_000_000)] = 115_200  # of the board's UART [bit/s]
    native_usb: bool = False  # the microcontroller has USB itself, so that lines take no time on a wire
    delay_ms: NonNegative = 0.0  # from the middle of a measurement to the first byte of its line on the wire

    def check(self, joints: Sequence[str], file: Path, text: str) -> None:
        """Raise ConfigError unless each of `joints` has exactly one encoder."""
        for place, what, key, remedy in self._mistakes(joints):
            raise ConfigError(what, file=file, line=line_in_entry(text, f"{TABLE}.encoders", place, key), remedy=remedy)
        require_each(joints, [encoder.joint for encoder in self.encoders], "encoder", f"{TABLE}.encoders", file, text)

    def _mistakes(self, joints: Sequence[str]) -> Iterator[tuple[int, str, str, str]]:
        seen_joints, seen_names = set[str](), set[str]()
        for place, encoder in enumerate(self.encoders):
            if encoder.joint not in joints:
                yield place, f"unknown joint {encoder.joint!r}", "joint", did_you_mean(encoder.joint, joints)
            if encoder.joint in seen_joints:
                yield place, f"a second encoder for the joint {encoder.joint!r}", "joint", "Give each joint one"
            if encoder.name in seen_names:
                yield place, f"the encoder {encoder.name!r} is given twice", "encoder", "Give each joint its own"
            seen_joints.add(encoder.joint)
            seen_names.add(encoder.name)
