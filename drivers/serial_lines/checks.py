"""Check a board's encoders and the rate of its lines. Only the request for its header is written to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bodyschema.drivers.checks import Check
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock

from .config import SerialLinesConfig
from .joints import SerialLineJoints

READ_S = 1.0
FEW_PER_S = 50.0
MANY_TROUBLES = 0.01


def encoder_checks(
    config: SerialLinesConfig, joints: Sequence[str], clock: Clock, *, read_s: float = READ_S
) -> Iterator[Check]:
    """Yield checks of the configured encoders and of their reading rate. Open the port for that."""
    try:
        with SerialLineJoints(config, joints, clock) as encoders:
            yield Check("encoders", "ok", f"all {len(joints)} of robot.toml are in the board's header")
            end, readings = clock.now() + read_s, 0
            while clock.now() < end:
                readings += encoders.read(end - clock.now()) is not None
            yield _rate(readings / read_s)
            counts = encoders.counts
            yield _troubles(counts.lines, counts.garbled + counts.missing)
            for complaint in encoders.health:
                said, _, fix = complaint.rpartition(": ")
                yield Check("encoders", "wrong", said, fix)
    except SourceError as error:
        yield Check("encoders", "wrong", str(error))


def _rate(rate_hz: float) -> Check:
    said = f"{rate_hz:.0f} readings/s come"
    if rate_hz < FEW_PER_S:
        return Check("rate", "warning", said, "a higher rate of the UART, fewer other things that the board does")
    return Check("rate", "ok", said)


def _troubles(lines: int, lost: int) -> Check:
    said = f"{lost} of {lines + lost} lines were garbled or missing"
    if lost > MANY_TROUBLES * (lines + lost):
        return Check("errors", "warning", said, "look at the cable, and whether the board keeps the rate exactly")
    return Check("errors", "ok", said)
