"""Question and answer on a bus of Dynamixel servos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from drivers.servos.bus import Answer, Exchange, Request, Trouble
from drivers.servos.bus import Bus as ServoBus
from drivers.servos.model import Register
from drivers.servos.packets import Packets

from .packets import PACKETS2, Garbled, packets_of

__all__ = ["Answer", "Bus", "Exchange", "Request", "Trouble", "read_request", "sync_request"]

FAST_HEADER = 8  # bytes before the first servo's part


def read_request(protocol: int, id: int, address: int, size: int) -> Request:
    """Ask one servo for part of its control table."""
    return Request(packets_of(protocol).read(id, address, size), (id,), size, protocol)


def sync_request(ids: Sequence[int], address: int, size: int, *, fast: bool) -> Request:
    """Ask several servos of Protocol 2.0 for the same part."""
    return Request(PACKETS2.sync_read(ids, address, size, fast=fast), tuple(ids), size, 2, fast)


class Bus(ServoBus):
    """Servos of Protocols 2.0 and 1.0 behind one port; knows the common answer to FAST_SYNC_READ."""

    @staticmethod
    def packets_of(protocol: int) -> Packets:
        """How to speak the protocol."""
        return packets_of(protocol)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """Write a register of servos of Protocol 2.0, by ID. Nobody answers: whoever needs to know has to ask."""
        data = {id: register.bytes(value) for id, value in values.items()}
        self.announce(PACKETS2.sync_write(register.address, register.size, data))

    def _collect(self, request: Request) -> Exchange:
        return self._collect_fast(request) if request.is_fast else super()._collect(request)

    def _collect_fast(self, request: Request) -> Exchange:
        inbox, count = self._inbox(request), len(request.ids)
        try:
            while (statuses := PACKETS2.take_fast(inbox.received, 0, count, request.size)) is None:
                if not inbox.fill():
                    return Exchange((), inbox.silence(0))
        except Garbled:
            return Exchange((), Trouble.GARBLED)
        answers: list[Answer] = []
        start_s = self._sent + len(request.packet) * self._byte_s + self.return_delay_s.get(request.ids[0], 0.0)
        at = FAST_HEADER
        for id, status in zip(request.ids, statuses, strict=True):
            trouble = self._doubt(request, id, status, FAST_HEADER + count * status.size)
            if trouble is not None:
                return Exchange(tuple(answers), trouble, id)
            answers.append(self._timed(status, start_s + at * self._byte_s, inbox, at))
            at += status.size
        return Exchange(tuple(answers), Trouble.GARBLED if len(inbox.received) > at else None)
