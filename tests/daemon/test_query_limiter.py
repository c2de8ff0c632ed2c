"""Queries that wait in the queue."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bodyschema.daemon.transport.query_limiter import LIMITS, TOTAL_RATIO, Limits, QueryLimiter
from bodyschema.interfaces.errors import RequestError


class Watch:
    """A clock that stands still until a test moves it."""

    t = 0.0

    def __call__(self) -> float:
        return self.t


def reception(watch: Watch | None = None, **limits: float) -> QueryLimiter[str]:
    return QueryLimiter(replace(LIMITS, **limits), watch or Watch())


def taken(desk: QueryLimiter[str], count: int) -> list[str]:
    return [turn[0] for turn in (desk.take() for _ in range(count)) if turn is not None]


def test_sources_take_turns_despite_a_greedy_one() -> None:
    desk = reception()
    for number in range(50):
        desk.admit("greedy", 0, f"greedy {number}")
    desk.admit("modest", 0, "modest")
    assert "modest" in taken(desk, 2)


def test_queries_of_one_source_keep_their_order() -> None:
    desk = reception()
    for number in range(5):
        desk.admit("one", 0, str(number))
    assert taken(desk, 5) == list("01234")


def test_source_over_its_waiting_limit_is_refused() -> None:
    desk = reception(waiting=3)
    for number in range(3):
        desk.admit("one", 0, str(number))
    with pytest.raises(RequestError, match="3 queries of the source one wait already, and that is the most"):
        desk.admit("one", 0, "3")
    desk.admit("another", 0, "welcome")
    assert len(taken(desk, 4)) == 4


def test_source_over_its_rate_is_refused_until_rest() -> None:
    watch = Watch()
    desk = reception(watch, rate_hz=10.0, burst=2)
    desk.admit("one", 0, "a")
    desk.admit("one", 0, "b")
    with pytest.raises(RequestError, match="asks too often; at most 10 queries/s, 2 at once after a rest"):
        desk.admit("one", 0, "c")
    watch.t = 0.11
    desk.admit("one", 0, "d")


def test_oversized_request_error_names_limit() -> None:
    with pytest.raises(RequestError, match="the request has 11 bytes; send at most 10"):
        reception(request_bytes=10).admit("one", 11, "large")


def test_waiting_bytes_are_limited_per_source_and_overall() -> None:
    limits = Limits(waiting_bytes=100, request_bytes=100)
    desk: QueryLimiter[str] = QueryLimiter(limits, Watch())
    for name in range(TOTAL_RATIO):
        desk.admit(str(name), 100, "full")
    with pytest.raises(RequestError, match="100 bytes of queries of the source 0 wait already, and 100 are the most"):
        desk.admit("0", 1, "more")
    with pytest.raises(RequestError, match="800 bytes of queries wait already, and 800 are the most"):
        desk.admit("another", 1, "more")
    desk.take()
    desk.admit("another", 100, "now there is room")


def test_query_that_waited_too_long_is_refused() -> None:
    watch = Watch()
    desk = reception(watch, wait_s=10.0)
    desk.admit("one", 0, "late")
    watch.t = 11.0
    query, refused = desk.take() or ("", None)
    assert query == "late"
    assert "the query waited 11 s for its turn; at most 10 s" in str(refused)


def test_served_sources_are_forgotten_and_excess_ones_refused() -> None:
    desk = reception(sources=2)
    for name in "abc":
        desk.admit(name, 0, name)
        desk.take()
    desk.admit("d", 0, "d")
    desk.admit("e", 0, "e")
    with pytest.raises(RequestError, match="2 clients wait already, and that is the most"):
        desk.admit("f", 0, "f")


def test_a_closed_reception_gives_nothing() -> None:
    desk = reception()
    desk.admit("one", 0, "a")
    desk.close()
    assert desk.take() is None
