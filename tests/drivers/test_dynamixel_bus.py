"""Requests and answers at a port that sends arbitrary bytes."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from virtual_port import VirtualClock

from bodyschema.drivers.dynamixel.bus import Answer, Bus, Trouble, sync_request
from bodyschema.drivers.dynamixel.emulator.frames import status_packet
from bodyschema.drivers.dynamixel.joints import Channel
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.dynamixel.packets import Status
from bodyschema.drivers.servos.servo import IdentifiedServo

DATA = bytes(range(16))
PIECES = st.lists(
    st.one_of(
        st.binary(max_size=40),
        st.builds(lambda id, size: status_packet(2, id, 0, DATA[:size]), st.integers(1, 3), st.sampled_from([16, 7])),
        st.builds(lambda id: status_packet(1, id, 0, DATA[:11]), st.integers(1, 3)),
    ),
    max_size=6,
)


class TalkingPort:
    """A port that sends its pieces, a millisecond apart, whatever the request."""

    baud = 1_000_000

    def __init__(self, clock: VirtualClock, pieces: list[bytes]) -> None:
        self._clock, self._pieces = clock, pieces

    def write(self, data: bytes) -> None:
        """Ignore the data."""

    def receive(self, until: float) -> bytes:
        next_s = self._clock.now() + 1e-3
        self._clock.wait_until(min(next_s, until))
        return self._pieces.pop(0) if next_s <= until and self._pieces else b""

    def flush(self) -> None:
        """Do nothing: nothing waits."""

    def close(self) -> None:
        """Do nothing: there is nothing to close."""


def fitted(model: str) -> IdentifiedServo:
    return IdentifiedServo("joint", "arm", 1, BY_NAME[model], 1, 2048, 46, 0, 3, 0, 0.0)


@given(PIECES)
def test_only_intact_answers_of_requested_servos_are_accepted(pieces) -> None:
    clock = VirtualClock()
    bus = Bus("arm", TalkingPort(clock, list(pieces)), clock, 0.0)
    exchange = bus.ask(sync_request(BY_NAME["XM430-W350"].layout, (1, 2), fast=False))
    said = b"".join(pieces)
    for answer, id in zip(exchange.answers, (1, 2), strict=False):
        assert answer.status.id == id
        assert status_packet(2, id, answer.status.error, answer.status.data) in said
    assert (exchange.trouble is None) is (len(exchange.answers) == 2 and said.startswith(whole(exchange.answers)))
    assert clock.now() < 101.0


def whole(answers: tuple[Answer, ...]) -> bytes:
    return b"".join(status_packet(2, a.status.id, a.status.error, a.status.data) for a in answers)


@given(PIECES)
def test_protocol_1_believes_no_more(pieces) -> None:
    clock = VirtualClock()
    bus = Bus("arm", TalkingPort(clock, list(pieces)), clock, 0.0)
    exchange = bus.ask(bus.read_request(BY_NAME["AX-12A"], 2, BY_NAME["AX-12A"].layout.block))
    assert exchange.trouble is not None or exchange.answers[0].status.id == 2
    assert clock.now() < 101.0


@given(st.binary(min_size=16, max_size=16))
def test_any_protocol_2_block_is_sample_or_refused(data) -> None:
    answer = Answer(Status(1, 0, data, 27), 100.0, 100.001, 99.999)
    sample = Channel(fitted("XM430-W350")).take(answer)
    assert sample is None or sample.ticks == int.from_bytes(data[12:], "little", signed=True)


@given(st.binary(min_size=11, max_size=11))
def test_any_protocol_1_block_is_sample_or_refused(data) -> None:
    answer = Answer(Status(1, 0, data, 17), 100.0, 100.001, 99.999)
    sample = Channel(fitted("AX-12A")).take(answer)
    assert sample is None or 0 <= sample.ticks <= 1023


def test_answer_faster_than_the_wire_is_refused() -> None:
    clock = VirtualClock()

    class Hasty(TalkingPort):
        def receive(self, until: float) -> bytes:
            return self._pieces.pop(0) if self._pieces else super().receive(until)

    bus = Bus("arm", Hasty(clock, [status_packet(2, 1, 0, DATA)]), clock, 0.0)
    model = BY_NAME["XM430-W350"]
    assert bus.ask(bus.read_request(model, 1, model.layout.block)).trouble is Trouble.EARLY
