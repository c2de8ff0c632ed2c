"""Request and answer on a bus of Dynamixel servos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bodyschema.drivers.servos.bus import Answer, Exchange, Request, Trouble, spare_after
from bodyschema.drivers.servos.bus import Bus as ServoBus
from bodyschema.drivers.servos.model import Layout, Register
from bodyschema.drivers.servos.packets import Packets

from .packets import PACKETS2, packets_of

__all__ = ["Answer", "Bus", "Exchange", "Request", "Trouble", "sync_request"]

FAST_HEADER = 8  # bytes before the first servo's part


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
        """Return the packet codec of the protocol."""
        return packets_of(protocol)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """Write a register of servos of Protocol 2.0, by ID. It is not acknowledged; read back if that matters."""
        data = {id: register.bytes(value) for id, value in values.items()}
        self.announce(PACKETS2.sync_write(register.address, register.size, data))

    def _collect(self, request: Request) -> Exchange:
        return self._collect_fast(request) if request.is_fast else super()._collect(request)

    def _collect_fast(self, request: Request) -> Exchange:
        inbox, count, size = self._inbox(request), len(request.ids), self._asked_size
        statuses, trouble = self._next(inbox, lambda received, at: PACKETS2.take_fast(received, at, count, size))
        if statuses is None:
            self._note_owed(request, request.ids)
            return Exchange((), trouble)
        answers: list[Answer] = []
        start_s = self._sent + self._question_size * self._byte_s + self.return_delay_s.get(request.ids[0], 0.0)
        part = FAST_HEADER
        for id, status in zip(request.ids, statuses, strict=True):
            trouble = self._doubt(request, id, status, FAST_HEADER + count * status.size)
            if trouble is not None:
                return Exchange(tuple(answers), trouble, id)
            answers.append(self._timed(request, status, start_s + part * self._byte_s, inbox, inbox.at + part))
            part += status.size
        is_garbled = len(inbox.received) > inbox.at + part
        return Exchange(tuple(answers), Trouble.GARBLED if is_garbled else None)
