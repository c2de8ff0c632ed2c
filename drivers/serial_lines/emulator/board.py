"""Emulate a microcontroller with encoders that sends a line per measurement."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from typing import Self

from bodyschema.drivers.emulator.device import Angle, Faults, Reply, byte_s, no_faults
from bodyschema.drivers.serial_lines.lines import SEQUENCES, STAMP_S, STAMPS, VERSION, with_checksum
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.protocols import JointSource
from bodyschema.interfaces.records import JointReading
from bodyschema.interfaces.waits import Waits

HEADER_EVERY_S = 1.0


class EncoderBoard:
    """An emulated board of encoders.

    Attributes:
        faults: applied to the lines; their id is 0.
        failing: encoders whose sensor has no value.
        glitch_ticks: error of an encoder [ticks], by name.
    """

    def __init__(
        self,
        # by name, ticks per turn, and shaft angle as a function of time [s]: [rad], 0 at the raw position 0
        encoders: Mapping[str, tuple[int, Angle]],
        *,
        rate_hz: float = 200.0,
        begun_s: float = 0.0,
        boot: int = 1,
        drift: float = 0.0,  # how much its clock is too fast
        faults: Faults = no_faults,
    ) -> None:
        self.encoders, self.faults = dict(encoders), faults
        self.failing: set[str] = set()
        self.glitch_ticks: dict[str, int] = {}
        self.lines = 0
        self._period_s, self._drift = 1 / rate_hz, drift
        self._start(begun_s, boot)

    @property
    def speaks_at(self) -> float:
        return self._next_s

    def reboot(self, t: float) -> None:
        """Cut the power and restore it at `t`."""
        self._start(t, (self._boot * 25_173 + 13_849) % SEQUENCES)

    def send(self, data: bytes, t: float, baud: int) -> list[Reply]:
        """Receive the host's `data`; a question mark requests the header, which comes with the next line."""
        del t, baud
        if b"?" in data:
            self._owes_header = True
        return []

    def speak(self, until: float, baud: int) -> list[Reply]:
        """Return the lines that begin by `until`."""
        replies: list[Reply] = []
        while self._next_s <= until:
            data = self._lines_at(self._next_s)
            replies.append(self.faults(Reply(0, self._next_s, data)))
            self._next_s += max(self._period_s, len(data) * byte_s(baud))  # it measures once the last line is sent
        return [reply for reply in replies if reply.data]

    def _start(self, t: float, boot: int) -> None:
        self._boot, self._begun_s, self._next_s = boot, t, t
        self._seq, self._header_s = 0, -math.inf
        self._owes_header = True

    def _lines_at(self, t: float) -> bytes:
        line = self._reading(t)
        if self._owes_header or t - self._header_s >= HEADER_EVERY_S:
            self._owes_header, self._header_s = False, t
            return line + self._header()
        return line

    def _reading(self, t: float) -> bytes:
        words = [self._ticks(name, t) for name in self.encoders]
        stamp = int((t - self._begun_s) * (1 + self._drift) / STAMP_S) % STAMPS
        line = with_checksum(",".join((str(self._seq), str(stamp), *words)))
        self._seq = (self._seq + 1) % SEQUENCES
        self.lines += 1
        return line

    def _ticks(self, name: str, t: float) -> str:
        if name in self.failing:
            return "-"
        per_turn, angle = self.encoders[name]
        return str((round(angle(t) * per_turn / (2 * math.pi)) + self.glitch_ticks.get(name, 0)) % per_turn)

    def _header(self) -> bytes:
        words = (f"{name},{per_turn}" for name, (per_turn, _) in self.encoders.items())
        return with_checksum(",".join(("H", str(VERSION), str(self._boot), str(len(self.encoders)), *words)))


class Listener:
    """Thread that reads an open source and keeps the newest reading."""

    def __init__(self, source: JointSource) -> None:
        self._source = source
        self._newest: JointReading | None = None
        self._error: BodyschemaError | None = None
        self._changed, self._stop = threading.Condition(), threading.Event()
        self._thread = threading.Thread(target=self._listen, name="emulator listener")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def after(self, t: float, timeout_s: float) -> JointReading | None:
        """Return the first reading after `t` [s], or None in time. Raise the error that ended the reading."""
        with self._changed:
            self._changed.wait_for(lambda: self._error is not None or self._is_after(t), timeout_s)
            if self._error is not None:
                raise self._error
            return self._newest if self._is_after(t) else None

    def _is_after(self, t: float) -> bool:
        return self._newest is not None and self._newest.t > t

    def _listen(self) -> None:
        try:
            while not self._stop.is_set():
                reading = self._source.read(Waits.poll_s)
                if reading is not None:
                    with self._changed:
                        self._newest = reading
                        self._changed.notify_all()
        except BodyschemaError as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()
