"""What comes from a board: bytes cut into lines, lines judged by checksum, sequence and the board's clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from bodyschema.drivers.device_clock import StreamClock

from .lines import LONGEST, SEQUENCES, STAMP_S, STAMPS, GarbledLine, Header, Reading, parse

DOUBTS = 5  # so many lines in a row from another time: the board was restarted, or the program stood still


@dataclass
class Counts:
    """How the lines went.

    Attributes:
        lines: intact readings in their order.
        garbled: no intact lines.
        missing: by the gaps in the sequence.
        out_of_order: came after a later one, or twice.
        of_another_time: by the board's clock.
    """

    lines: int = 0
    garbled: int = 0
    missing: int = 0
    out_of_order: int = 0
    of_another_time: int = 0


@dataclass(frozen=True, slots=True)
class Timed:
    """A reading, when it was measured [s], and the 1-sigma of that [s]."""

    t: float
    sigma: float
    reading: Reading


class LineCutter:
    """Cuts what arrives into lines, with the time at which each was begun at the latest."""

    def __init__(self, byte_s: float) -> None:
        """Nothing has arrived.

        Args:
            byte_s: how long a byte takes on the wire [s].
        """
        self._byte_s = byte_s
        self._rest = bytearray()
        self._is_whole = False  # what is first heard may be the end of a line

    def cut(self, data: bytes, arrived: float) -> tuple[list[tuple[bytes, float]], int]:
        """The lines that are complete with `data`, and how many were too long to be any."""
        self._rest += data
        lines: list[tuple[bytes, float]] = []
        overlong = 0
        while (end := self._rest.find(b"\n")) >= 0:
            begun = arrived - len(self._rest) * self._byte_s
            if self._is_whole:
                lines.append((bytes(self._rest[:end]), begun))
            self._is_whole = True
            del self._rest[: end + 1]
        if len(self._rest) > LONGEST:
            self._rest.clear()
            overlong, self._is_whole = int(self._is_whole), False
        return lines, overlong


class Board:
    """A board's lines since it was opened.

    Attributes:
        header: what it says of itself, once it has.
        counts: how its lines went.
        restarted: it says so itself, or its clock does.
    """

    def __init__(self, byte_s: float, delay_s: float) -> None:
        """Nothing was heard.

        Args:
            byte_s: how long a byte takes on the wire [s].
            delay_s: from the measurement to the first byte on the wire [s].
        """
        self.header: Header | None = None
        self.counts, self.restarted = Counts(), False
        self._cutter, self._delay_s = LineCutter(byte_s), delay_s
        self._clock = StreamClock(STAMP_S, STAMPS)
        self._seq: int | None = None
        self._doubts = 0
        self._readings: deque[Timed] = deque()

    def hear(self, data: bytes, arrived: float) -> None:
        """Take in what arrived by `arrived` [s]."""
        lines, overlong = self._cutter.cut(data, arrived)
        self.counts.garbled += overlong
        for line, begun in lines:
            try:
                said = parse(line)
            except GarbledLine:
                self.counts.garbled += 1
                continue
            if isinstance(said, Header):
                self._introduce(said)
            else:
                self._take(said, begun)

    @property
    def is_waiting(self) -> bool:
        """Whether there are readings that were not given yet."""
        return bool(self._readings)

    def next(self) -> Timed | None:
        """The oldest reading that was not given yet."""
        return self._readings.popleft() if self._readings else None

    def _introduce(self, header: Header) -> None:
        if self.header is not None and header != self.header:
            self.restarted = True
        self.header = self.header or header

    def _take(self, reading: Reading, begun: float) -> None:
        if self.header is None or len(reading.ticks) != len(self.header.encoders):
            self.counts.garbled += self.header is not None
            return
        if self._seq is not None:
            ahead = (reading.seq - self._seq) % SEQUENCES
            if not 0 < ahead < SEQUENCES // 2:
                self.counts.out_of_order += 1
                self._doubt()
                return
            self.counts.missing += ahead - 1
        t = self._clock.time(begun, reading.t_us)
        if t is None:
            self.counts.of_another_time += 1
            self._doubt()
            return
        self._seq, self._doubts = reading.seq, 0
        self.counts.lines += 1
        self._readings.append(Timed(t - self._delay_s, self._clock.sigma_s, reading))

    def _doubt(self) -> None:
        self._doubts += 1
        self.restarted = self.restarted or self._doubts >= DOUBTS
