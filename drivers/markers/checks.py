"""Check that a marker source sends usable positions, and at what rate."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bodyschema.drivers.checks import Check
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import MarkerFix

from .stream import SILENT_AFTER_S, MarkerStream

READ_S = 2.5  # until the clock of the stamps is known to milliseconds
WAIT_S = 0.1
FEW_PER_S = 15.0


def stream_checks(stream: MarkerStream, clock: Clock, read_s: float = READ_S) -> Iterator[Check]:
    """Yield checks of the positions that come, of their rate and time, and of the messages that cannot be used.

    Args:
        stream: not open; it is closed again afterwards.
        clock: the clock.
        read_s: duration of the look [s].
    """
    subject = f"marker source {stream.name}"
    try:
        with stream:
            fixes: list[MarkerFix] = []
            end = clock.now() + max(read_s, SILENT_AFTER_S + WAIT_S)
            while clock.now() < end:
                seen = stream.read(WAIT_S)
                if isinstance(seen, MarkerFix):
                    fixes.append(seen)
            complaints = stream.health
    except SourceError as error:
        what, _, remedy = str(error).partition(". ")
        yield Check(subject, "wrong", what, remedy)
        return
    if fixes:
        yield from _of_fixes(subject, fixes)
    elif not complaints:
        yield Check(subject, "wrong", "no usable position came", "bodyschema watch marker")
    for complaint in complaints:
        what, _, remedy = complaint.removeprefix(f"{stream.name}: ").partition(": ")
        yield Check(subject, "warning" if fixes else "wrong", what, remedy)


def _of_fixes(subject: str, fixes: list[MarkerFix]) -> Iterator[Check]:
    last = fixes[-1]
    rate = (len(fixes) - 1) / max(last.t - fixes[0].t, WAIT_S)
    place = ", ".join(f"{1e3 * value:.1f}" for value in last.x)
    sigma = 1e3 * float(np.sqrt(np.linalg.eigvalsh(last.cov)[-1]))
    said = f"{rate:.0f} positions/s, last at ({place}) mm ± {sigma:.2g} mm, time known to {1e3 * last.t_sigma:.1f} ms"
    if rate < FEW_PER_S:
        yield Check(subject, "warning", said, "let the source send more often: 30 to 100 a second")
    else:
        yield Check(subject, "ok", said)
