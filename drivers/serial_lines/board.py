"""Split a board's bytes into lines, and check them by checksum, sequence number and the board's clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from bodyschema.drivers.device_clock import StreamClock

from .lines import LONGEST, SEQUENCES, STAMP_S, STAMPS, GarbledLine, Header, Reading, parse

DOUBTS = 5  # consecutive implausible lines: the board was restarted, or the program was suspended


@dataclass
class Counts:
    """Number of lines by outcome."""

    lines: int = 0  # intact readings in order
    garbled: int = 0  # damaged lines
    missing: int = 0  # by the gaps in the sequence
    out_of_order: int = 0  # arrived after a later one, or twice


@dataclass(frozen=True, slots=True)
class Timed:
    """A reading, its time of measurement [s], and the 1-sigma of that time [s]."""

    t: float
    sigma: float
    reading: Reading


class LineCutter:
    """Splitter of incoming bytes into lines, with the latest possible start time of each."""

    def __init__(self, byte_s: float) -> None:
        """Start with an empty buffer.

        Args:
            byte_s: duration of a byte on the wire [s].
        """
        self._byte_s = byte_s
        self._rest = bytearray()
        self._is_whole = False  # the first bytes received may be the end of a line

    def cut(self, data: bytes, arrived: float) -> tuple[list[tuple[bytes, float]], int]:
        """Return the lines completed by `data`, and the number of overlong ones."""
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
        restarted: True if the board was restarted, by its header or its clock.
    """

    def __init__(self, byte_s: float, delay_s: float) -> None:
        """Start without data.

        Args:
            byte_s: duration of a byte on the wire [s].
            delay_s: from the measurement to the first byte on the wire [s].
        """
        self.header: Header | None = None
        self.counts, self.restarted = Counts(), False
        self._cutter, self._delay_s = LineCutter(byte_s), delay_s
        self._clock = StreamClock(STAMP_S, STAMPS)
        self._seq: int | None = None
        self._implausible = 0
        self._readings: deque[Timed] = deque()

    def hear(self, data: bytes, arrived: float) -> None:
        """Process the bytes that arrived by `arrived` [s]."""
        lines, overlong = self._cutter.cut(data, arrived)
        self.counts.garbled += overlong
        for line, begun in lines:
            try:
                parsed = parse(line)
            except GarbledLine:
                self.counts.garbled += 1
                continue
            if isinstance(parsed, Header):
                self._introduce(parsed)
            else:
                self._take(parsed, begun)

    @property
    def is_waiting(self) -> bool:
        """True if there are readings that were not returned yet."""
        return bool(self._readings)

    def next(self) -> Timed | None:
        """Return the oldest reading that was not returned yet."""
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
                self._note_implausible()
                return
            self.counts.missing += ahead - 1
        t = self._clock.time(begun, reading.t_us)
        if t is None:
            self._note_implausible()
            return
        self._seq, self._implausible = reading.seq, 0
        self.counts.lines += 1
        self._readings.append(Timed(t - self._delay_s, self._clock.sigma_s, reading))

    def _note_implausible(self) -> None:
        self._implausible += 1
        self.restarted = self.restarted or self._implausible >= DOUBTS
