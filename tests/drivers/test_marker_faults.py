"""Messages of marker sources that are damaged, doubled, late, of another body or in another unit: each is named."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pytest
from sent_markers import AHEAD_S, PERIOD_S, Sent

from bodyschema.drivers.markers.datagram import SCHEMA
from bodyschema.interfaces.records import MarkerFix, MarkerMiss, Reason

GOOD = 200


def faulty(**keys) -> Sent:
    """Return a source after good messages."""
    sent = Sent(**keys)
    if "body" in keys:
        sent.send(GOOD, body="tool")
    else:
        sent.send(GOOD)
    return sent


def test_intact_messages_become_dated_fixes() -> None:
    sent = Sent(latency_s=0.02, latency_sigma_s=0.001)
    cov = [[4e-6, 1e-6, 0.0], [1e-6, 4e-6, 0.0], [0.0, 0.0, 9e-6]]
    fix = sent.send(GOOD, covariance=cov)[-1]
    assert fix.t == pytest.approx(sent.clock.now() - 0.02, abs=1e-4)
    np.testing.assert_allclose(fix.cov, cov)
    assert sent.stream.health == ()


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ({"raw": b"{"}, "malformed"),
        ({"raw": b"\xff\xfe"}, "malformed"),
        ({"raw": b"[" * 4000}, "malformed"),
        ({"raw": json.dumps({"schema": "other/1", "position": [0, 0, 0]}).encode()}, "malformed"),
        ({"position": ...}, "malformed"),
        ({"position": [0.1, 0.2]}, "malformed"),
        ({"position": [0.1, float("nan"), 0.3]}, "not_finite"),
        ({"position": [512.0, 100.0, 900.0]}, "unit"),
        ({"covariance": [[1, 2, 0], [0, 1, 0], [0, 0, 1]]}, "covariance"),
        ({"covariance": [1e-6, 0, 0, 0, -1e-6, 0, 0, 0, 1e-6]}, "covariance"),
        ({"covariance": [0.5, 0, 0, 0, 0.5, 0, 0, 0, 0.5]}, "covariance"),
        ({"covariance": [1.0, 2.0]}, "covariance"),
        ({"quaternion": [0, 0, 0, 2]}, "turn"),
        ({"stamp": 0.0}, "no_stamp"),
        ({"stamp": 1e300}, "delayed"),
        ({"sender": "b"}, "rival"),
    ],
)
def test_unusable_messages_are_counted_by_reason(message, fault) -> None:
    sent = faulty()
    assert sent.send(20, **message) == []
    assert sent.counts == {"used": GOOD, fault: 20}
    [said] = sent.stream.health
    assert said.startswith("udp: 20 of the last 220 messages ")
    assert said.count(": ") >= 2  # what, and the remedy


def test_hidden_marker_is_a_miss() -> None:
    sent = faulty()
    assert [seen.reason for seen in sent.send(3, tracked=False, position=None)] == [Reason.NO_MARKER] * 3
    assert sent.stream.health == ()


def test_lost_messages_are_counted_by_their_numbers() -> None:
    sent = faulty()
    sent.send(20, skip=1)
    assert sent.counts == {"used": GOOD + 20, "lost": 20}
    assert "were lost: use a cable" in sent.stream.health[0]


def test_late_and_damaged_messages_are_not_lost() -> None:
    sent = faulty()
    sent.send(seq=GOOD + 2)
    sent.send(seq=GOOD + 1, stamp=sent.clock.now() + AHEAD_S - PERIOD_S)
    sent.send(2, raw=b"{")
    sent.send(seq=GOOD + 5)
    assert {what: count for what, count in sent.counts.items() if count} == {
        "used": GOOD + 2,
        "out_of_order": 1,
        "malformed": 2,
    }


def test_duplicate_and_older_messages_are_not_used() -> None:
    sent = faulty()
    newest = sent.clock.now() + AHEAD_S
    sent.send(stamp=newest, seq=GOOD)
    sent.send(stamp=newest - 3 * PERIOD_S, seq=GOOD - 3)
    assert sent.counts == {"used": GOOD, "duplicate": 1, "out_of_order": 1}


def test_order_without_stamps_is_that_of_the_numbers() -> None:
    sent = Sent()
    sent.send(10, stamp=...)
    sent.send(seq=10, stamp=...)
    sent.send(seq=4, stamp=...)
    assert sent.counts == {"used": 10, "duplicate": 1, "out_of_order": 1}


def test_late_messages_are_refused() -> None:
    sent = faulty(max_delay_s=0.05)
    for _ in range(12):
        sent.send(stamp=sent.clock.now() + AHEAD_S - 0.2 + PERIOD_S)
        sent.send()
    assert sent.counts["used"] == GOOD + 12
    assert sent.counts.get("delayed", 0) + sent.counts.get("out_of_order", 0) == 12


def test_restarted_sender_is_followed_again() -> None:
    sent = faulty()
    sent.seq = 0
    assert len(sent.send(400, stamp=...)) > 390


def test_burst_of_late_messages_is_no_restarted_sender() -> None:
    sent = Sent()
    sent.send(10, stamp=...)
    sent.send(seq=20, stamp=...)
    for seq in range(10, 18):
        assert sent.send(seq=seq, stamp=...) == []
    assert len(sent.send(seq=21, stamp=...)) == 1
    assert {what: count for what, count in sent.counts.items() if count} == {"used": 12, "out_of_order": 8, "lost": 2}


def test_marker_is_told_from_another_body() -> None:
    sent = faulty(body="tool")
    assert sent.send(5, body="table") == []
    assert sent.stream.health == ()
    other = Sent(body="tool")
    other.send(5, body="table")
    assert "are of another body ('table', not 'tool'): correct body" in other.stream.health[0]


def test_two_bodies_need_a_name() -> None:
    sent = Sent()
    sent.send(5, body="tool")
    assert sent.send(5, body="table") == []
    assert "are of several bodies (table, tool): name the marker's" in sent.stream.health[0]


def test_millimetres_are_converted_where_declared() -> None:
    sent = Sent(unit="mm")
    fix = sent.send(position=[100.0, 200.0, 300.0], covariance=[0.25, 0, 0, 0, 0.25, 0, 0, 0, 0.25])[0]
    np.testing.assert_allclose(fix.x, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(fix.cov, 0.25e-6 * np.eye(3))


def test_metres_declared_as_millimetres_are_named() -> None:
    sent = Sent(unit="mm")
    assert sent.send(30, position=[0.4, 0.2, 0.3]) == []
    assert 'as if they were in metres (0.54 mm): send millimetres, or take out unit = "mm"' in sent.stream.health[0]


def test_constant_rotation_is_no_orientation() -> None:
    sent = Sent()
    assert sent.send(quaternion=[0, 0, 0, 1])[0].R is None
    turned = sent.send(quaternion=[0, 0, 0.6, 0.8])[0]
    np.testing.assert_allclose(turned.R, [0, 0, 0.6, 0.8])


def test_silent_source_is_reported() -> None:
    sent = faulty()
    sent.clock.wait_until(sent.clock.now() + 3.0)
    assert sent.stream.read(0.0) is None
    assert sent.stream.health == ("udp: no message for 3 s: start it",)


def test_times_increase_strictly_under_any_order() -> None:
    rng = np.random.default_rng(0)
    sent = Sent()
    seen: list[MarkerFix | MarkerMiss] = []
    for _ in range(500):
        late = rng.exponential(0.02)
        seen += sent.send(stamp=sent.clock.now() + AHEAD_S - late, tracked=bool(rng.random() < 0.9))
    assert len(seen) > 100
    assert all(b.t > a.t for a, b in pairwise(seen))


def test_schema_is_the_documented_one() -> None:
    assert SCHEMA == "bodyschema.marker/1"
