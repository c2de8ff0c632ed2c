from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import msgspec
import numpy as np
import pytest
from guided_arm import STORE, Scene, make_pair, new_learning

from bodyschema.daemon.learner.feed import FeedSettings, PairFeed
from bodyschema.daemon.sampler.history import Page, read_page
from bodyschema.daemon.transport.wire import PairMessage, PairsReply, encode, pair_to_wire
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.interfaces.records import Pair
from bodyschema.interfaces.waits import Waits
from bodyschema.learning.online_learner import OnlineLearner

PAGE = 7
PAIRS = Scene.draw(0, 40).pairs


class HandClock:
    """A clock that is moved by hand."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def utc(self) -> str:
        return ""


# A step takes one offer; these are extra, for offers that only wake the feed and to catch up.
SPARE_STEPS = 5


class Store:
    """The sampler's history: answers a page at a time, or not at all."""

    def __init__(self, pairs: list[Pair]) -> None:
        self.pairs, self.store, self.asked, self.answers = pairs, STORE, 0, True
        self.gone = self.goes = 0  # number of the oldest pairs that are deleted, and increase per answer
        self.refusal: str | None = None
        self.last_seq: int | None = None  # where it is not how many pairs there are

    def __call__(self, begin: int) -> Page:
        self.asked += 1
        if not self.answers:
            raise BusError("nobody answers")
        if self.refusal is not None:
            raise RequestError(self.refusal)
        page = [pair_to_wire(pair) for pair in self.pairs if pair.seq >= max(begin, self.gone + 1)][:PAGE]
        self.gone = min(self.gone + self.goes, len(self.pairs) - 1)
        return read_page(encode(PairsReply(self.store, self.last_seq or len(self.pairs), page)))


def payload(pair: Pair) -> bytes:
    return encode(pair_to_wire(pair))


class Fed:
    """A feed with what is around it."""

    def __init__(self, stored: int = 0) -> None:
        self.learning: OnlineLearner = new_learning()
        self.clock = HandClock()
        self.history = Store(PAIRS[:stored])
        self.feed = PairFeed(self.learning, self.history, self.clock)
        self._offered = 0

    def publish(self, *pairs: Pair) -> None:
        self._offered += len(pairs)
        for pair in pairs:
            self.feed.offer(payload(pair))

    def settle(self) -> None:
        """Take all that has been offered, and what is behind."""
        for _ in range(self._offered + SPARE_STEPS):
            self.clock.time += Waits.retry_s
            self.feed.step(0.0)
        self._offered = 0

    @property
    def learnt(self) -> tuple[int, int]:
        return self.learning.counters.pairs, self.learning.counters.last_seq


def test_stored_pairs_are_learnt_page_by_page() -> None:
    fed = Fed(stored=20)
    fed.settle()
    assert fed.learnt == (20, 20)
    assert fed.learning.counters.gaps_recovered == 20


def test_published_pairs_are_learnt_without_querying_history() -> None:
    fed = Fed(stored=5)
    fed.settle()
    asked = fed.history.asked
    fed.publish(*PAIRS[5:20])
    fed.settle()
    assert (fed.learnt, fed.history.asked) == ((20, 20), asked)


def test_gap_is_filled_from_history_before_later_pairs() -> None:
    fed = Fed(stored=5)
    fed.settle()
    fed.history.pairs = PAIRS[:20]
    fed.publish(PAIRS[19])
    fed.settle()
    assert fed.learnt == (20, 20)


@pytest.mark.parametrize("again", [[4], [0, 4], [4, 4, 3]])
def test_repeated_pair_is_not_learnt_again(again) -> None:
    fed = Fed(stored=5)
    fed.settle()
    fed.publish(*(PAIRS[k] for k in again))
    fed.settle()
    assert fed.learnt == (5, 5)


@pytest.mark.parametrize("seed", range(5))
def test_lost_doubled_shuffled_publications_are_learnt_once(seed) -> None:
    rng = np.random.default_rng(seed)
    fed = Fed()
    for end in (10, 25, 40):
        fed.history.pairs = PAIRS[:end]
        fed.publish(*(PAIRS[k] for k in rng.integers(0, end, size=rng.integers(0, 30))))
        if rng.random() < 0.5:
            fed.feed.wake()
        fed.settle()
    fed.feed.wake()
    fed.settle()
    assert fed.learnt == (40, 40)


def test_queue_overflow_is_recovered_from_history() -> None:
    fed = Fed(stored=1)
    fed.settle()
    fed.history.pairs = PAIRS[:10]
    fed.publish(*[PAIRS[1]] * (FeedSettings.max_waiting + 50))
    fed.settle()
    assert fed.learnt == (10, 10)


def test_unanswered_feed_retries_and_catches_up() -> None:
    fed = Fed(stored=10)
    fed.history.answers = False
    fed.feed.step(0.0)
    fed.clock.time += Waits.retry_s
    fed.feed.step(0.0)
    assert (fed.history.asked, fed.learnt) == (2, (0, 0))
    fed.history.answers = True
    fed.settle()
    assert fed.learnt == (10, 10)


def test_pairs_published_while_paused_are_learnt_after_resume() -> None:
    fed = Fed(stored=5)
    fed.settle()
    fed.feed.pause()
    fed.history.pairs = PAIRS[:10]
    fed.publish(*PAIRS[5:10])
    for _ in range(6):
        fed.feed.step(0.0)
    assert fed.learnt == (5, 5)
    fed.feed.resume()
    fed.settle()
    assert fed.learnt == (10, 10)


# --- pairs that the sampler no longer keeps


def test_new_learner_starts_at_oldest_kept_pair(caplog) -> None:
    fed = Fed(stored=20)
    fed.history.gone = 12
    fed.settle()
    assert fed.learnt == (8, 20)
    assert fed.learning.counters.missed == 12
    assert "has no samples 1 to 12 any more" in caplog.text


def test_returning_learner_continues_and_counts_missed_pairs() -> None:
    fed = Fed(stored=5)
    fed.settle()
    fed.history.pairs, fed.history.gone = PAIRS[:30], 20
    fed.publish(*PAIRS[28:30])
    fed.settle()
    assert fed.learnt == (15, 30)
    assert (fed.learning.counters.missed, fed.feed.problem) == (15, None)


def test_pairs_deleted_during_catch_up_are_skipped() -> None:
    fed = Fed(stored=30)
    fed.history.goes = 10  # with each answer
    fed.settle()
    assert fed.learnt[1] == 30
    assert fed.learnt[0] + fed.learning.counters.missed == 30
    assert fed.learning.counters.missed > 0


@pytest.mark.parametrize("lost", [[7], [1], [6, 7, 8], [7, 8, 14], [2, 19, 20]])
def test_pairs_that_a_disk_changed_are_passed_over(lost) -> None:
    fed = Fed(stored=20)
    fed.history.pairs = [pair for pair in PAIRS[:20] if pair.seq not in lost]
    fed.history.last_seq = 20
    fed.settle()
    fed.history.pairs += PAIRS[20:22]
    fed.history.last_seq = 22
    fed.publish(PAIRS[21])
    fed.settle()
    assert fed.learnt == (22 - len(lost), 22)
    assert (fed.learning.counters.missed, fed.learning.counters.gaps_recovered) == (len(lost), 22 - len(lost))
    assert fed.feed.problem is None


# --- invalid pairs


def wrong(pair: Pair) -> list[bytes]:
    message: PairMessage = pair_to_wire(pair)
    return [
        b"",
        b"{",
        payload(replace(pair, q=pair.q[:3])),
        payload(replace(pair, x=np.array([1e309, 0.0, 0.0]))),
        encode(msgspec.structs.replace(message, q=[float("nan"), 0.0, 0.0, 0.0])),
        encode(message).replace(b'"seq":6', b'"seq":-6'),
    ]


@pytest.mark.parametrize("kind", range(6))
def test_invalid_pair_is_refused_and_counted(kind) -> None:
    fed = Fed(stored=5)
    fed.settle()
    fed.feed.offer(wrong(PAIRS[5])[kind])
    fed.feed.step(0.0)
    assert (fed.learnt, fed.learning.counters.refused) == ((5, 5), 1)


def test_valid_pair_is_learnt_after_invalid_one() -> None:
    fed = Fed(stored=5)
    fed.settle()
    fed.feed.offer(wrong(PAIRS[5])[2])
    fed.publish(*PAIRS[5:8])
    fed.settle()
    assert fed.learnt == (8, 8)


def test_pairs_of_another_store_are_rejected_with_remedy() -> None:
    fed = Fed(stored=5)
    fed.settle()
    fed.publish(make_pair(6, PAIRS[5].q, PAIRS[5].x, store="other"))
    fed.settle()
    assert fed.learnt == (5, 5)
    assert "samples now come from the store other" in fed.feed.problem
    assert "reset_to_prior" in fed.feed.problem


def test_older_copy_of_store_is_reported() -> None:
    fed = Fed(stored=10)
    fed.settle()
    fed.history.pairs = PAIRS[:4]
    fed.feed.wake()
    fed.settle()
    assert fed.learnt == (10, 10)
    assert "ends at sample 4, but 10 were learnt: it is an older copy" in fed.feed.problem


@pytest.mark.parametrize("spoilt", [[7], [1], [6, 7, 8], [1, 20]])
def test_invalid_stored_pairs_are_refused_later_ones_learnt(spoilt) -> None:
    fed = Fed(stored=20)
    for seq in spoilt:
        fed.history.pairs[seq - 1] = replace(PAIRS[seq - 1], x=np.array([np.nan, 0.0, 1.0]))
    fed.settle()
    assert fed.learnt == (20 - len(spoilt), 20 if 20 not in spoilt else 19)
    assert fed.learning.counters.refused == len(spoilt)
    assert f"sample {spoilt[-1]} is not a PairMessage" in fed.feed.refused


def test_refused_history_is_reported_until_granted() -> None:
    fed = Fed(stored=10)
    fed.history.refusal = "the store is damaged"
    fed.feed.step(0.0)
    assert fed.feed.problem == "the sampler does not give the samples from 1 on: the store is damaged"
    fed.history.refusal = None
    fed.settle()
    assert (fed.learnt, fed.feed.problem) == ((10, 10), None)


def stored_at(seconds: float) -> str:
    return (datetime(2026, 11, 21, 12, tzinfo=UTC) + timedelta(seconds=seconds)).isoformat(timespec="milliseconds")


# One pair a second.
TIMED = [replace(pair, utc=stored_at(float(pair.seq))) for pair in PAIRS]


def timed(stored: int) -> Fed:
    fed = Fed()
    fed.history.pairs = TIMED[:stored]
    return fed


def age_s(fed: Fed) -> float | None:
    return fed.feed.age_s(fed.learning.snapshot.newest_utc)


def test_before_any_pair_nothing_has_an_age() -> None:
    fed = Fed()
    assert (fed.feed.behind, age_s(fed)) == (0, None)


def test_lagging_learner_has_age_of_newest_learnt_pair() -> None:
    fed = timed(10)
    fed.settle()
    fed.feed.pause()
    fed.history.pairs = TIMED[:35]
    fed.publish(TIMED[34])
    fed.clock.time += 3.0
    assert fed.feed.behind == 25
    assert age_s(fed) == pytest.approx(25.0 + 3.0)


def test_unread_history_pages_count_as_behind() -> None:
    fed, seen = timed(40), []
    learn = fed.learning.learn

    def noting(pair: Pair, now: float) -> None:
        learn(pair, now)
        seen.append((fed.feed.behind, age_s(fed)))

    fed.learning.learn = noting
    fed.settle()
    assert [round(age or 0.0) for _, age in seen] == [40 - seq for seq in range(1, 41)]
    assert (fed.feed.behind, seen[PAGE][0]) == (0, 40 - PAGE)


def test_up_to_date_learner_ages_from_newest_pair() -> None:
    fed = timed(5)
    fed.settle()
    fed.publish(TIMED[5])
    fed.feed.step(0.0)
    fed.clock.time += 7.0
    assert (fed.feed.behind, age_s(fed)) == (0, 7.0)


@pytest.mark.parametrize("payload", [b"", b"{}", encode({"store": "another", "seq": 9, "utc": ""})])
def test_foreign_or_invalid_payload_leaves_backlog_unchanged(payload: bytes) -> None:
    fed = timed(5)
    fed.settle()
    fed.feed.offer(payload)
    assert fed.feed.behind == 0


@pytest.mark.parametrize("utc", ["", "yesterday", "2026-11-21T12:00:00", "1970-01-01T00:00:00+00:00"])
def test_unusable_utc_does_not_increase_age(utc: str) -> None:
    fed = timed(5)
    fed.settle()
    fed.publish(replace(TIMED[5], utc=utc))
    assert age_s(fed) == 0.0
