"""Scan for Dynamixel servos of both protocols."""

from __future__ import annotations

from bodyschema.drivers.scan import ScannedPort
from bodyschema.drivers.servos.bus import BITS_PER_BYTE
from bodyschema.drivers.servos.scan import HOST_S, IDS, Kind, PingScanner, heard
from bodyschema.interfaces.protocols import Clock

from .bus import Bus
from .models import BY_NUMBER, HARDWARE_ERRORS, UNSUPPORTED
from .packets import BROADCAST, PACKETS2, Version

LIKELY_FIRST = (1_000_000, 57_600, 2_000_000, 115_200, 3_000_000, 4_000_000, 9_600)
FASTEST1 = 3_000_000  # of Protocol 1.0
SLOT_S = 3e-3  # a servo of Protocol 2.0 waits this long for each ID below its own
PING2 = 10  # bytes


def _kind(version: Version) -> Kind:
    return Kind(
        name=f"Dynamixel {version}.0",
        bauds=tuple(baud for baud in LIKELY_FIRST if version == 2 or baud <= FASTEST1),
        version=version,
        models={number: model for number, model in BY_NUMBER.items() if model.protocol == version},
        errors=HARDWARE_ERRORS,
        bus=Bus,
        unsupported=UNSUPPORTED if version == 2 else {},
    )


PROTOCOL1, PROTOCOL2 = _kind(1), _kind(2)


class Protocol2Scanner(PingScanner):
    """Scanner of Protocol 2.0.

    At slow rates a broadcast PING finds all servos. If an answer is garbled, each ID is asked by itself. At fast rates,
    where a packet takes less time than a servo's slot to answer the broadcast, each ID is asked by itself from the
    start.
    """

    def __init__(self) -> None:
        super().__init__(PROTOCOL2, question=PING2)

    def _ids(self, port: ScannedPort, clock: Clock, latency_s: float) -> list[int]:
        if self._spacing_s(port.baud) < SLOT_S:
            return super()._ids(port, clock, latency_s)
        port.flush()
        port.write(PACKETS2.ping(BROADCAST))
        wire_s = sum(self._ping_sizes) * BITS_PER_BYTE / port.baud
        received = heard(port, clock, clock.now() + len(IDS) * SLOT_S + 2 * latency_s + HOST_S + wire_s)
        statuses, is_clean = self._statuses(received)
        return sorted({status.id for status in statuses}) if is_clean else super()._ids(port, clock, latency_s)
