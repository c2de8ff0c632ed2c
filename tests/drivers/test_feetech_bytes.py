"""Feetech's bytes: fuzzed parsers, and the emulator's rules."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_dynamixel_bus import TalkingPort
from virtual_port import VirtualClock

from bodyschema.drivers.feetech.emulator.arm import Chain, Code, instructions_in, summed
from bodyschema.drivers.feetech.emulator.servo import CALIBRATE, Servo
from bodyschema.drivers.feetech.joints import PACKETS, Bus, Channel
from bodyschema.drivers.feetech.models import BY_NAME, MODELS
from bodyschema.drivers.servos.bus import Answer, Request
from bodyschema.drivers.servos.model import Register
from bodyschema.drivers.servos.packets import Garbled, Status
from bodyschema.drivers.servos.servo import IdentifiedServo

BAUD = 1_000_000
NOISE = st.lists(st.one_of(st.binary(max_size=12), st.sampled_from([b"\xff\xff", b"\xff"]))).map(b"".join)
PIECES = st.lists(
    st.one_of(
        st.binary(max_size=40),
        st.builds(lambda id, size: summed(id, 0, bytes(size)), st.integers(1, 3), st.sampled_from([15, 7])),
    ),
    max_size=6,
)


def test_instructions_are_those_of_the_manual_s_examples() -> None:
    assert PACKETS.ping(1) == bytes.fromhex("ff ff 01 02 01 fb")
    assert PACKETS.read(1, 0x38, 2) == bytes.fromhex("ff ff 01 04 02 38 02 be")
    assert PACKETS.sync_read((1, 2), 0x38, 8) == bytes.fromhex("ff ff fe 06 82 38 08 01 02 36")


@given(data=NOISE, id=st.integers(0, 252), error=st.integers(0, 255))
def test_status_packet_is_parsed_as_sent(data, id, error) -> None:
    packet = summed(id, error, data[:200])
    status = PACKETS.take(packet, 0)
    assert status == Status(id, error, data[:200], len(packet))


@given(data=NOISE, at=st.integers(0, 5))
def test_any_bytes_are_packet_incomplete_or_refused(data, at) -> None:
    try:
        status = PACKETS.take(data, at)
    except Garbled:
        return
    assert status is None or at + status.size <= len(data)


@given(PIECES)
def test_only_intact_answers_of_requested_servos_are_accepted(pieces) -> None:
    clock = VirtualClock()
    bus = Bus("arm", TalkingPort(clock, list(pieces)), clock, 0.0)
    exchange = bus.ask(Request(lambda n: PACKETS.sync_read((1, 2), 56, n), (1, 2), 15, 0))
    said = b"".join(pieces)
    for answer, id in zip(exchange.answers, (1, 2), strict=False):
        assert answer.status.id == id
        assert summed(id, answer.status.error, answer.status.data) in said
    assert clock.now() < 101.0


@pytest.mark.parametrize(("model", "size"), [("STS3215", 15), ("SCS0009", 11)])
@given(data=st.data())
def test_any_block_is_a_possible_sample_or_refused(model, size, data) -> None:
    servo = IdentifiedServo("joint", "arm", 1, BY_NAME[model], 1, 2048, 778, 0, 0, 0, 0.0)
    block = data.draw(st.binary(min_size=size, max_size=size))
    sample = Channel(servo).take(Answer(Status(1, 0, block, size + 6), 100.0, 100.001, 99.999))
    assert sample is None or abs(sample.ticks) <= (30_719 if model == "STS3215" else 1023)


@given(st.lists(NOISE, max_size=5))
def test_emulator_survives_any_bytes(chunks) -> None:
    chain = Chain([Servo(BY_NAME["STS3215"], 1, lambda t: 0.0), Servo(BY_NAME["SCS0009"], 2, lambda t: 0.0)])
    for k, chunk in enumerate(chunks):
        chain.send(chunk, k * 1e-3, BAUD)
    servo = chain.servos[0]
    assert chain.send(PACKETS.ping(servo.id), 1.0, servo.baud)


@given(st.integers(0, 252), st.integers(0, 255), st.binary(min_size=1, max_size=60))
def test_emulator_parses_any_write_instruction(id, address, data) -> None:
    found, done = instructions_in(bytearray(PACKETS.write(id, address, data)))
    assert [(i.id, i.code, i.params) for i in found] == [(id, 3, bytes((address,)) + data)]
    assert done == found[0].end


@given(st.integers(-2047, 2047))
def test_sign_bit_follows_the_series_byte_order(value) -> None:
    little, big = Register(31, 2, sign_bit=11), Register(31, 2, sign_bit=11, order="big")
    assert little.value(little.bytes(value)) == big.value(big.bytes(value)) == value
    assert little.bytes(value) == big.bytes(value)[::-1]
    assert int.from_bytes(little.bytes(-1), "little") == 0x801


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_a_model_s_number_is_read_in_its_order(model) -> None:
    chain = Chain([Servo(model, 7, lambda t: 0.0)])
    (reply,) = chain.send(PACKETS.read(7, 3, 2), 0.0, BAUD)
    order = "big" if model.series == "SCS" else "little"
    assert int.from_bytes(reply.data[5:7], order) == model.number


# --- the emulator's rules


def told(chain: Chain, address: int, size: int, t: float = 1.0) -> bytes:
    (reply,) = chain.send(PACKETS.read(1, address, size), t, BAUD)
    return reply.data[5:-1]


def test_write_to_locked_eeprom_reverts_on_power_cycle() -> None:
    for lock, kept in ((1, 0), (0, 5)):
        chain = Chain([Servo(BY_NAME["STS3215"], 1, lambda t: 0.0, return_delay_s=0)])
        chain.send(PACKETS.write(1, 55, bytes((lock,))), 0.0, BAUD)
        chain.send(PACKETS.write(1, 7, b"\x05"), 0.1, BAUD)
        assert told(chain, 7, 1) == b"\x05"
        chain.power_cycle(2.0)
        assert told(chain, 7, 1, 3.0) == bytes((kept,))


def test_measured_values_cannot_be_written() -> None:
    chain = Chain([Servo(BY_NAME["STS3215"], 1, lambda t: 0.0)])
    chain.send(PACKETS.write(1, 56, b"\x05\x00"), 0.0, BAUD)
    assert told(chain, 56, 2) == (2048).to_bytes(2, "little")


def test_torque_register_can_set_the_middle() -> None:
    chain = Chain([Servo(BY_NAME["STS3215"], 1, lambda t: 1.0)])
    chain.send(PACKETS.write(1, 40, bytes((CALIBRATE,))), 0.0, BAUD)
    assert told(chain, 56, 2) == (2048).to_bytes(2, "little")
    assert told(chain, 40, 1, 2.0) == b"\x00"


def test_overload_switches_torque_off_until_power_cycle() -> None:
    chain = Chain([Servo(BY_NAME["STS3215"], 1, lambda t: 0.0)])
    servo = chain.servo(1)
    servo["torque"] = 1
    servo.fail(0x20)
    (reply,) = chain.send(PACKETS.ping(1), 0.0, BAUD)
    assert (servo["torque"], reply.data[4]) == (0, 0x20)
    chain.power_cycle(1.0)
    (reply,) = chain.send(PACKETS.ping(1), 2.0, BAUD)
    assert reply.data[4] == 0


def test_sync_read_is_answered_in_requested_order() -> None:
    chain = Chain([Servo(BY_NAME["STS3215"], id, lambda t: 0.5, return_delay_s=0) for id in (1, 2, 3)])
    replies = chain.send(PACKETS.sync_read((3, 1), 56, 2), 0.0, BAUD)
    assert [reply.data[2] for reply in replies] == [3, 1]
    assert replies[1].start == pytest.approx(replies[0].start + 8 * 10 / BAUD)
    assert int.from_bytes(replies[0].data[5:7], "little") == 2048 + round(0.5 * 4096 / (2 * math.pi))


def test_a_broadcast_ping_is_answered_by_each() -> None:
    chain = Chain([Servo(BY_NAME["STS3215"], id, lambda t: 0.0) for id in (6, 2, 1, 252)])
    replies = chain.send(PACKETS.ping(0xFE), 0.0, BAUD)
    assert [reply.data for reply in replies] == [summed(id, 0, b"") for id in (1, 2, 6, 252)]
    ends = [reply.start + 6 * 10 / BAUD for reply in replies]
    assert all(end < after.start for end, after in zip(ends[:-1], replies[1:], strict=True))


@pytest.mark.parametrize(
    ("model", "address", "size", "number"),
    [
        ("STS3215", 9, 2, 0),
        ("STS3215", 11, 2, 4095),
        ("STS3215", 13, 1, 70),
        ("STS3215", 14, 1, 80),
        ("STS3215", 16, 2, 1000),
        ("STS3215", 21, 1, 32),
        ("STS3215", 48, 2, 1000),
        ("SCS0009", 11, 2, 1023),
    ],
)
def test_limits_are_those_of_a_new_servo(model, address, size, number) -> None:
    chain = Chain([Servo(BY_NAME[model], 1, lambda t: 0.0)])
    order = "big" if model == "SCS0009" else "little"
    assert int.from_bytes(told(chain, address, size), order) == number
    chain.send(PACKETS.write(1, address, bytes(size)), 2.0, BAUD)
    body = bytes((1, 2, Code.RESET))
    chain.send(b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)), 3.0, BAUD)
    assert int.from_bytes(told(chain, address, size, 4.0), order) == number


def test_a_registered_write_waits_for_action() -> None:
    chain = Chain([Servo(BY_NAME["STS3215"], 1, lambda t: 0.0)])
    body = bytes((1, 5, 4, 42, 0x10, 0x00))
    chain.send(b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)), 0.0, BAUD)
    assert chain.servo(1)["goal"] == 0
    body = bytes((0xFE, 2, 5))
    chain.send(b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)), 0.1, BAUD)
    assert chain.servo(1)["goal"] == 16
