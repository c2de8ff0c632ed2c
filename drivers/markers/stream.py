"""Positions sent by another program, as a `MarkerSource`."""

from __future__ import annotations

import logging
import math
import threading
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Protocol, Self

import numpy as np

from bodyschema.drivers.checks import Check, warned
from bodyschema.drivers.markers.config import SourceTable
from bodyschema.drivers.markers.report import ADVICE, Fault, Packet, Report, Unusable
from bodyschema.drivers.ros2.cdr import Malformed
from bodyschema.drivers.ros2.senders import Refusal, Sender
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss, Reason, frozen_array
from bodyschema.interfaces.waits import Waits


class _Settings:
    lately_s: float = 10.0
    bucket_s: float = 1.0
    # A share of faulty messages below this costs no pairs worth a message to a person.
    many: float = 0.02
    # The first messages of a clock that is not known yet may be refused.
    min_to_report: int = 4
    # with unit = "mm": metres, divided by 1000, are all nearer to the origin
    nearest_m: float = 0.005
    # a wider covariance is in mm², or useless
    widest_sigma_m: float = 0.2
    asymmetry: float = 1e-6
    # quaternions of single precision, and those written with three digits
    unit_length: float = 0.01
    # consecutive lower numbers: the sender was started again
    restart: int = 3
    few_per_s: float = 15.0
    farthest_m: float = 50.0  # no arm is measured over a larger distance: such a number is in millimetres
    max_senders: int = 64  # whose sequence numbers are kept
    read_s: float = 2.5  # until the clock of the stamps is known to milliseconds


USED = "used"


class MessageCounters:
    """Counters of used and unused messages, in total and of the last `lately_s`; for any thread."""

    def __init__(self) -> None:
        self.total: Counter[str] = Counter()
        self._buckets: deque[tuple[float, Counter[str]]] = deque()
        self._details: dict[Fault, str] = {}
        self._lock = threading.Lock()

    def note(self, t: float, what: Fault | str, detail: str = "", count: int = 1) -> bool:
        """Count messages at time `t` [s]; return True once this fault is frequent enough to report."""
        with self._lock:
            if not self._buckets or t - self._buckets[-1][0] >= _Settings.bucket_s:
                self._buckets.append((t, Counter()))
                while t - self._buckets[0][0] > _Settings.lately_s:
                    self._buckets.popleft()
            self._buckets[-1][1][what] += count
            self.total[what] += count
            if isinstance(what, Fault) and detail:
                self._details[what] = detail
            return self.total[what] - count < _Settings.min_to_report <= self.total[what]

    def lately(self, now: float) -> Counter[str]:
        """Return the counts of the last seconds."""
        counts: Counter[str] = Counter()
        with self._lock:
            for t, bucket in self._buckets:
                if now - t <= _Settings.lately_s:
                    counts += bucket
        return counts

    def complaints(self, now: float, name: str) -> Iterator[str]:
        """Yield the faults of the messages of the last seconds, with the remedy."""
        counts = self.lately(now)
        # Other bodies matter only if the marker's own is missing; a hidden marker counts as a rejected fix.
        ignored = {Fault.NOT_TRACKED} | ({Fault.OTHER_BODY} if counts[USED] or counts[Fault.NOT_TRACKED] else set())
        total = sum(count for what, count in counts.items() if what not in ignored)
        for fault in Fault:
            if fault in ignored or counts[fault] <= _Settings.many * total:
                continue
            yield f"{name}: {counts[fault]} of the last {total} messages {self.describe(fault)}"

    def describe(self, fault: Fault) -> str:
        """Return the description of a fault, with its newest detail and the remedy."""
        what, remedy = ADVICE[fault]
        detail = self._details.get(fault, "")
        return f"{what}{f' ({detail})' if detail else ''}: {remedy}"


log = logging.getLogger(__name__)


Decode = Callable[[bytes, bytes], Iterable[Report]]


class Receiver(Protocol):
    """The connection that messages arrive on."""

    def open(self) -> None:
        """Open it; raise SourceError if that fails."""

    def close(self) -> None:
        """Close it; closing it again does no harm."""

    def receive(self, until: float) -> Packet | None:
        """Return the next message; None when none arrives by `until` [s].

        Raises:
            SourceLost: the other end is gone.
        """

    def silence(self) -> str:
        """Return a possible reason why nothing arrives, with the remedy."""
        ...


class MarkerStream:
    """A `MarkerSource` of messages: decoded, checked, and timestamped on this machine's clock.

    The sender's clock is mapped to ours by the fastest messages. Unusable messages are dropped and counted; `health`
    reports them with the remedy.
    """

    def __init__(self, table: SourceTable, receiver: Receiver, decode: Decode, clock: Clock) -> None:
        self._table, self._receiver, self._decode, self._clock = table, receiver, decode, clock
        self.name = table.label
        self._is_open = False
        self._last_t = -math.inf
        self.ledger = MessageCounters()
        self._forget()

    @property
    def health(self) -> tuple[str, ...]:
        """Current problems, each with its remedy."""
        now = self._clock.now()
        messages, silence = list(self.ledger.complaints(now, self.name)), self._silence
        if self._is_open and silence is not None:
            messages.append(f"{self.name}: no message for {now - self._heard:.0f} s: {silence}")
        return tuple(messages)

    def __enter__(self) -> Self:
        self._receiver.open()
        self._forget()
        self._is_open = True
        return self

    def __exit__(self, *_: object) -> None:
        self._is_open = False
        self._receiver.close()

    def read(self, timeout_s: float) -> MarkerFix | MarkerMiss | None:
        """Return the next position; see `MarkerSource.read`."""
        if not self._is_open:
            raise SourceError(f"the marker source {self.name} is not open; use it in a with statement")
        deadline = self._clock.now() + timeout_s
        while not self._waiting:
            packet = self._receiver.receive(deadline)
            if packet is None:
                # Find out once why nothing arrives; this may take a second.
                if self._silence is None and self._clock.now() - self._heard > Waits.silent_after_s:
                    self._silence = self._receiver.silence()
                return None
            self._take(packet)
            if not self._waiting and self._clock.now() >= deadline:
                return None
        return self._waiting.popleft()

    def _forget(self) -> None:
        """Reset everything learnt from earlier messages."""
        self._waiting: deque[MarkerFix | MarkerMiss] = deque()
        self._heard = self._clock.now()
        self._silence: str | None = None
        self._sender: Hashable = None
        self._sender_heard = -math.inf
        self._clock_of: Sender = Sender(self._table.max_delay_s)
        self._numbers: dict[Hashable, _Numbers] = {}
        self._unread = 0  # messages since the last one with a number
        self._bodies: dict[str, float] = {}
        self._frame: str | None = None
        self._first_turn: tuple[float, ...] | None = None
        self._turns = False

    def _take(self, packet: Packet) -> None:
        self._heard, self._silence = packet.arrived, None
        try:
            for report in self._decode(packet.payload, packet.attached):
                self._take_report(report, packet)
        except Unusable as error:
            self._unread += 1
            self._refuse(packet.arrived, error.fault, error.detail)
        except Malformed as error:
            self._unread += 1
            self._refuse(packet.arrived, Fault.MALFORMED, str(error))

    def _take_report(self, report: Report, packet: Packet) -> None:
        try:
            seen = self._fix(report, packet)
        except Unusable as error:
            self._refuse(packet.arrived, error.fault, error.detail)
            return
        if isinstance(seen, MarkerFix):
            self.ledger.note(packet.arrived, USED)
        self._last_t = seen.t
        self._waiting.append(seen)

    def _refuse(self, t: float, fault: Fault, detail: str) -> None:
        if self.ledger.note(t, fault, detail) and fault != Fault.OTHER_BODY:
            log.warning("%s: a message was not used; such messages %s", self.name, self.ledger.describe(fault))

    def _fix(self, report: Report, packet: Packet) -> MarkerFix | MarkerMiss:
        arrived = packet.arrived
        order = self._count_lost(report.seq, packet)
        self._require_body(report, arrived)
        self._require_frame(report)
        self._require_one_sender(packet)
        if order is not None and report.stamp_ns is None:
            raise Unusable(order)
        t, sigma_s = self._time(report, arrived)
        if t <= self._last_t:
            raise Unusable(Fault.OUT_OF_ORDER)
        if report.x is None:
            self.ledger.note(arrived, Fault.NOT_TRACKED)
            return MarkerMiss(t, Reason.NO_MARKER)
        if not all(map(math.isfinite, report.x)):
            self._refuse(arrived, Fault.NOT_FINITE, "position")
            return MarkerMiss(t, Reason.NOT_FINITE)
        x = self._position(report.x)
        cov, cov_turn = self._covariances(report)
        R = self._turned(report.turn)
        return MarkerFix(t, x, cov, t_sigma=sigma_s, R=R, cov_R=None if R is None else cov_turn)

    def _require_one_sender(self, packet: Packet) -> None:
        if packet.sender != self._sender:
            if packet.arrived - self._sender_heard < Waits.rival_after_s:
                raise Unusable(Fault.RIVAL, f"{packet.sender} beside {self._sender}")
            if self._sender is not None:
                self._clock_of = Sender(self._table.max_delay_s)
            self._sender = packet.sender
        self._sender_heard = packet.arrived

    def _require_body(self, report: Report, arrived: float) -> None:
        if report.body is None:
            if self._table.body is not None and not report.where:
                raise Unusable(Fault.OTHER_BODY, f"without a name, not {self._table.body!r}")
            return
        if self._table.body is not None:
            if str(self._table.body) not in (report.body, *report.where):
                self._bodies[report.body] = arrived
                raise Unusable(Fault.OTHER_BODY, f"{report.body!r}, not {str(self._table.body)!r}")
            return
        self._bodies[report.body] = arrived
        there = sorted(name for name, t in self._bodies.items() if arrived - t < Waits.silent_after_s)
        if len(there) > 1:
            raise Unusable(Fault.SEVERAL_BODIES, ", ".join(there))

    def _require_frame(self, report: Report) -> None:
        if report.frame is None:
            return
        if self._frame is None:
            self._frame = report.frame
        if report.frame != self._frame:
            raise Unusable(Fault.OTHER_FRAME, f"{report.frame!r}, not {self._frame!r}")

    def _time(self, report: Report, arrived: float) -> tuple[float, float]:
        """Return the time of the measurement and its 1-sigma [s]."""
        if report.stamp_ns is None:
            return arrived - self._table.latency_s, math.hypot(SourceTable.usual_sigma_s, self._table.sigma_s)
        times_set = self._clock_of.times_set
        t = self._clock_of.time_of(report.stamp_ns, (0,), arrived)
        if self._clock_of.times_set != times_set:
            log.warning("%s: the clock of its stamps was set; its time is learnt again", self.name)
        if isinstance(t, Refusal):
            raise Unusable(Fault(t.value))
        return t - report.age_s - self._table.latency_s, math.hypot(self._clock_of.sigma_s, self._table.sigma_s)

    def _count_lost(self, seq: int | None, packet: Packet) -> Fault | None:
        """Count the sequence numbers missing in the sender's messages; return the verdict on their order."""
        if seq is None:
            return None
        numbers = self._numbers.get(packet.sender)
        if numbers is None:
            if len(self._numbers) >= _Settings.max_senders:
                self._numbers.clear()
            numbers = self._numbers[packet.sender] = _Numbers()
        lost, order = numbers.count(seq, self._unread)
        self._unread = 0
        if lost and packet.sender == self._sender and self.ledger.note(packet.arrived, Fault.LOST, count=lost):
            log.warning("%s: %d messages %s", self.name, lost, self.ledger.describe(Fault.LOST))
        return order

    def _position(self, sent: tuple[float, ...]) -> FloatArray:
        x = self._table.metres * np.array(sent)
        if float(np.linalg.norm(x)) > _Settings.farthest_m:
            raise Unusable(Fault.UNIT, f"{float(np.linalg.norm(x)):.4g} m")
        if self._table.unit == "mm" and float(np.linalg.norm(x)) < _Settings.nearest_m:
            raise Unusable(Fault.SMALL_UNIT, f"{1e3 * float(np.linalg.norm(x)):.2g} mm")
        return frozen_array(x)

    def _covariances(self, report: Report) -> tuple[FloatArray, FloatArray | None]:
        """Return the covariances of position [m²] and rotation [rad²], (3, 3) each; None if no rotation was sent."""
        if report.cov is None or not any(report.cov):  # ROS: all zeros if unknown
            sigma_m = max(self._table.sigma_m, self._table.metres * report.spread)
            return frozen_array(sigma_m**2 * np.eye(3)), None
        size = math.isqrt(len(report.cov))
        whole = np.array(report.cov).reshape(size, size)
        cov = self._table.metres**2 * self._proper(whole[:3, :3])
        if float(np.linalg.eigvalsh(cov)[-1]) > _Settings.widest_sigma_m**2:
            raise Unusable(Fault.COVARIANCE, f"1-sigma {math.sqrt(float(np.linalg.eigvalsh(cov)[-1])):.3g} m")
        turn = whole[3:, 3:] if size == 6 and whole[3:, 3:].any() else None
        return frozen_array(cov), None if turn is None else frozen_array(self._proper(turn))

    @staticmethod
    def _proper(cov: FloatArray) -> FloatArray:
        """Return a covariance that is symmetric and positive definite."""
        if not np.isfinite(cov).all() or np.abs(cov - cov.T).max() > _Settings.asymmetry * np.abs(cov).max():
            raise Unusable(Fault.COVARIANCE, "not symmetric, or not finite")
        if float(np.linalg.eigvalsh(cov)[0]) <= 0.0:
            raise Unusable(Fault.COVARIANCE, "not positive definite")
        return 0.5 * (cov + cov.T)

    def _turned(self, turn: tuple[float, ...] | None) -> FloatArray | None:
        """Return the unit quaternion, but None until it changes: trackers of points send a constant rotation."""
        if turn is None or not any(turn):
            return None
        length = math.sqrt(sum(part * part for part in turn))
        if not abs(length - 1.0) < _Settings.unit_length:
            raise Unusable(Fault.TURN, f"length {length:.3g}")
        if self._first_turn is None:
            self._first_turn = turn
        self._turns = self._turns or turn != self._first_turn
        return frozen_array(np.array(turn) / length) if self._turns else None


class _Numbers:
    """The sequence numbers of a sender's messages."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._lower = self._lost = 0
        self._missing: deque[range] = deque(maxlen=100)  # bounds the time for each message

    def count(self, seq: int, unread: int) -> tuple[int, Fault | None]:
        """Return the number of messages lost before `seq`, and the fault if it is not a newer one.

        Args:
            seq: number of a message. A late one that was counted as lost counts as -1.
            unread: number of messages since the previous one whose numbers could not be read.
        """
        before = self._newest
        if before is None or seq > before:
            first = seq if before is None else before + 1
            lost = max(seq - first - unread, 0)
            self._newest, self._lower, self._lost = seq, 0, self._lost + lost
            if lost:
                self._missing.append(range(first, seq))
            return lost, None
        gap = next((gap for gap in self._missing if seq in gap), None)
        if gap is not None:
            self._missing.remove(gap)
            self._missing.extend(part for part in (range(gap.start, seq), range(seq + 1, gap.stop)) if part)
            late = int(self._lost > 0)
            self._lost -= late
            return -late, Fault.OUT_OF_ORDER
        self._lower += seq < before
        if self._lower >= _Settings.restart:
            self._newest, self._lower = seq, 0
            self._missing.clear()
            return 0, None
        return 0, Fault.DUPLICATE if seq == before else Fault.OUT_OF_ORDER


def stream_checks(stream: MarkerStream, clock: Clock, read_s: float = _Settings.read_s) -> Iterator[Check]:
    """Yield checks of the positions, of their rate and time, and of the unusable messages.

    Args:
        stream: a closed stream; it is closed again afterwards.
    """
    subject = f"marker source {stream.name}"
    try:
        with stream:
            fixes: list[MarkerFix] = []
            end = clock.now() + max(read_s, Waits.silent_after_s + Waits.poll_s)
            while clock.now() < end:
                seen = stream.read(Waits.poll_s)
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
    rate = (len(fixes) - 1) / max(last.t - fixes[0].t, Waits.poll_s)
    place = ", ".join(f"{1e3 * value:.1f}" for value in last.x)
    sigma = 1e3 * float(np.sqrt(np.linalg.eigvalsh(last.cov)[-1]))
    message = (
        f"{rate:.0f} positions/s, last at ({place}) mm ± {sigma:.2g} mm, time known to {1e3 * last.t_sigma:.1f} ms"
    )
    fix = "let the source send more often: 30 to 100 a second"
    yield warned(subject, message, fix, when=rate < _Settings.few_per_s)
