"""Count what came of a source lately, and say what is wrong with it."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterator

from .report import ADVICE, Fault

LATELY_S = 10.0
BUCKET_S = 1.0
# A share of faulty messages below this costs no pairs worth a message to a person.
MANY = 0.02
# The first messages of a clock that is not known yet may be refused.
WORTH_A_WORD = 4
USED = "used"


class Ledger:
    """Counters of used and unused messages, in total and of the last `LATELY_S`; for any thread.

    Attributes:
        total: number of messages by fault, and the used ones.
    """

    def __init__(self) -> None:
        self.total: Counter[str] = Counter()
        self._buckets: deque[tuple[float, Counter[str]]] = deque()
        self._details: dict[Fault, str] = {}
        self._lock = threading.Lock()

    def note(self, t: float, what: Fault | str, detail: str = "", count: int = 1) -> bool:
        """Count messages at time `t` [s]; return True once there are enough of this fault to tell a person."""
        with self._lock:
            if not self._buckets or t - self._buckets[-1][0] >= BUCKET_S:
                self._buckets.append((t, Counter()))
                while t - self._buckets[0][0] > LATELY_S:
                    self._buckets.popleft()
            self._buckets[-1][1][what] += count
            self.total[what] += count
            if isinstance(what, Fault) and detail:
                self._details[what] = detail
            return self.total[what] - count < WORTH_A_WORD <= self.total[what]

    def lately(self, now: float) -> Counter[str]:
        """Return the counts of the last seconds."""
        counts: Counter[str] = Counter()
        with self._lock:
            for t, bucket in self._buckets:
                if now - t <= LATELY_S:
                    counts += bucket
        return counts

    def complaints(self, now: float, name: str) -> Iterator[str]:
        """Yield what is wrong with the messages of the last seconds, with the remedy."""
        counts = self.lately(now)
        # Other bodies matter only where the marker's does not come; that it is hidden counts as a rejected fix.
        usual = {Fault.NOT_TRACKED} | ({Fault.OTHER_BODY} if counts[USED] or counts[Fault.NOT_TRACKED] else set())
        whole = sum(count for what, count in counts.items() if what not in usual)
        for fault in Fault:
            if fault in usual or counts[fault] <= MANY * whole:
                continue
            yield f"{name}: {counts[fault]} of the last {whole} messages {self.explained(fault)}"

    def explained(self, fault: Fault) -> str:
        """Return what a fault is, with its newest detail and the remedy."""
        what, remedy = ADVICE[fault]
        detail = self._details.get(fault, "")
        return f"{what}{f' ({detail})' if detail else ''}: {remedy}"
