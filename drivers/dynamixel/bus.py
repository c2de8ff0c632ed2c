"""Request and answer on a bus of Dynamixel servos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bodyschema.drivers.echo import HOST_S, Port
from bodyschema.drivers.servos.bus import BITS_PER_BYTE, Answer, Exchange, Request, Trouble, spare_after
from bodyschema.drivers.servos.bus import Bus as ServoBus
from bodyschema.drivers.servos.model import Layout, Register
from bodyschema.drivers.servos.packets import Packets
from bodyschema.drivers.servos.scan import IDS, PingScanner, ServoProtocol, receive_until
from bodyschema.interfaces.protocols import Clock

from .models import BY_NUMBER, FAST_HEADER, FASTEST1, HARDWARE_ERRORS, PING_SLOT_S, UNSUPPORTED
from .packets import BROADCAST, PACKETS2, Version, packets_of

__all__ = ["Answer", "Bus", "Exchange", "Request", "Trouble", "sync_request"]


def sync_request(layout: Layout, ids: Sequence[int], *, fast: bool) -> Request:
    """Ask several servos of Protocol 2.0 for the block that contains their positions."""
    block = layout.block

    def packet(size: int) -> bytes:
        return PACKETS2.sync_read(ids, block.address, size, fast=fast)

    return Request(packet, tuple(ids), block.size, layout.protocol, spare_after(layout, block), fast)


class Bus(ServoBus):
    """Servos of Protocols 2.0 and 1.0 behind one port; supports the common answer to FAST_SYNC_READ."""

    @staticmethod
    def packets_of(protocol: int) -> Packets:
        return packets_of(protocol)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """Write a register of servos of Protocol 2.0, by ID. It is not acknowledged; read back if that matters."""
        data = {id: register.bytes(value) for id, value in values.items()}
        self.announce(PACKETS2.sync_write(register.address, register.size, data))

    def _collect(self, request: Request) -> Exchange:
        return self._collect_fast(request) if request.is_fast else super()._collect(request)

    def _collect_fast(self, request: Request) -> Exchange:
        inbox, count, size = self._inbox(request), len(request.ids), self._requested_size
        statuses, trouble = self._next(inbox, lambda received, at: PACKETS2.take_fast(received, at, count, size))
        if statuses is None:
            self._note_overdue(request, request.ids)
            return Exchange((), trouble)
        answers: list[Answer] = []
        start_s = self._sent + self._request_bytes * self._byte_s + self.return_delay_s.get(request.ids[0], 0.0)
        part = FAST_HEADER
        for id, status in zip(request.ids, statuses, strict=True):
            trouble = self._mismatch(request, id, status, FAST_HEADER + count * status.size)
            if trouble is not None:
                return Exchange(tuple(answers), trouble, id)
            answers.append(self._timed(request, status, start_s + part * self._byte_s, inbox, inbox.at + part))
            part += status.size
        is_garbled = len(inbox.received) > inbox.at + part
        return Exchange(tuple(answers), Trouble.GARBLED if is_garbled else None)


LIKELY_FIRST = (1_000_000, 57_600, 2_000_000, 115_200, 3_000_000, 4_000_000, 9_600)


def _protocol(version: Version) -> ServoProtocol:
    return ServoProtocol(
        name=f"Dynamixel {version}.0",
        bauds=tuple(baud for baud in LIKELY_FIRST if version == 2 or baud <= FASTEST1),
        version=version,
        models={number: model for number, model in BY_NUMBER.items() if model.protocol == version},
        errors=HARDWARE_ERRORS,
        bus=Bus,
        unsupported=UNSUPPORTED if version == 2 else {},
    )


PROTOCOL1, PROTOCOL2 = _protocol(1), _protocol(2)


class Protocol2Scanner(PingScanner):
    """Scanner of Protocol 2.0.

    At slow rates a broadcast PING finds all servos. If an answer is garbled, each ID is asked by itself. At fast rates,
    where a packet takes less time than a servo's slot to answer the broadcast, each ID is asked by itself from the
    start.
    """

    def __init__(self) -> None:
        super().__init__(PROTOCOL2)

    def _ids(self, port: Port, clock: Clock, latency_s: float) -> list[int]:
        if self._spacing_s(port.baud) < PING_SLOT_S:
            return super()._ids(port, clock, latency_s)
        port.flush()
        port.write(PACKETS2.ping(BROADCAST))
        wire_s = sum(self._ping_sizes) * BITS_PER_BYTE / port.baud
        received = receive_until(port, clock, clock.now() + len(IDS) * PING_SLOT_S + 2 * latency_s + HOST_S + wire_s)
        statuses, is_clean = self._statuses(received)
        return sorted({status.id for status in statuses}) if is_clean else super()._ids(port, clock, latency_s)
