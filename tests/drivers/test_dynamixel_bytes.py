"""Parsers of bytes from outside, fuzzed, and compared with dynamixel-sdk's own arithmetic and data."""

from __future__ import annotations

from contextlib import suppress
from importlib.resources import files
from random import Random

import dynamixel_sdk as sdk
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.drivers.dynamixel.crc16 import crc16
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.frames import fast_block, fast_header, instructions_in, status_packet
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.models import BY_NAME, MODELS, baud_of, baud_value
from bodyschema.drivers.dynamixel.packets import PACKETS1, PACKETS2, Garbled, packets_of
from bodyschema.drivers.emulator.device import Reply
from bodyschema.drivers.emulator.faults import corrupt

HEADERS = st.sampled_from([b"\xff\xff\xfd\x00", b"\xff\xff\xfd", b"\xff\xff", b"\xfd"])
NOISE = st.lists(st.one_of(st.binary(max_size=12), HEADERS)).map(b"".join)


@given(st.binary(max_size=300))
def test_the_checksum_is_the_sdk_s(data) -> None:
    assert crc16(data) == sdk.PacketHandler(2.0).updateCRC(0, data, len(data))


@given(st.binary(max_size=100), st.binary(max_size=100))
def test_the_checksum_goes_on_where_it_stopped(first, second) -> None:
    assert crc16(second, crc16(first)) == crc16(first + second)


@pytest.mark.parametrize("protocol", [1, 2])
@given(data=NOISE, id=st.integers(0, 252), error=st.integers(0, 255))
def test_status_packet_is_parsed_as_sent(protocol, data, id, error) -> None:
    packet = status_packet(protocol, id, error, data[:200])
    status = packets_of(protocol).take(packet, 0)
    assert status is not None
    assert (status.id, status.error, status.data, status.size) == (id, error, data[:200], len(packet))


@pytest.mark.parametrize("protocol", [1, 2])
@given(data=NOISE, id=st.integers(0, 252), cut=st.integers(0, 40))
def test_a_part_of_a_packet_is_not_complete(protocol, data, id, cut) -> None:
    packet = status_packet(protocol, id, 0, data[:200])
    assert packets_of(protocol).take(packet[: min(cut, len(packet) - 1)], 0) is None


@pytest.mark.parametrize("packets", [PACKETS1, PACKETS2])
@given(data=NOISE, at=st.integers(0, 5))
def test_any_bytes_are_packet_incomplete_or_refused(packets, data, at) -> None:
    try:
        status = packets.take(data, at)
    except Garbled:
        return
    assert status is None or at + status.size <= len(data)


@given(st.lists(st.binary(min_size=16, max_size=16), min_size=1, max_size=6), st.data())
def test_fast_answer_is_split_or_refused_when_corrupt(blocks, draw) -> None:
    packet = fast_header([16] * len(blocks))
    for id, data in enumerate(blocks, 1):
        packet += fast_block(packet, id, 0, data)
    statuses = PACKETS2.take_fast(packet, 0, len(blocks), 16)
    assert statuses is not None
    assert [status.data for status in statuses] == blocks
    place = draw.draw(st.integers(0, len(packet) - 1))
    wrong = bytearray(packet)
    wrong[place] ^= draw.draw(st.integers(1, 255))
    with suppress(Garbled):
        assert PACKETS2.take_fast(wrong, 0, len(blocks), 16) is None  # its length announces more bytes


@given(st.integers(0, 252), st.integers(0, 600), NOISE.filter(bool))
def test_emulator_parses_any_write_instruction(id, address, data) -> None:
    found, done = instructions_in(bytearray(PACKETS2.write(id, address, data[:60])))
    assert [(i.id, i.code, i.params, i.intact) for i in found] == [
        (id, 3, address.to_bytes(2, "little") + data[:60], True)
    ]
    assert done == found[0].end


@given(st.lists(NOISE, max_size=5))
def test_emulator_survives_any_bytes(chunks) -> None:
    chain = Chain([Servo(BY_NAME["XM430-W350"], 1, lambda t: 0.0), Servo(BY_NAME["AX-12A"], 2, lambda t: 0.0)])
    for k, chunk in enumerate(chunks):
        chain.send(chunk, k * 1e-3, 1_000_000)
    servo = chain.servos[0]
    assert chain.send(PACKETS2.ping(servo.id), 1.0, servo.baud)


@given(NOISE.filter(lambda noise: not noise.endswith((b"\xff", b"\xfd"))))
def test_emulator_finds_an_instruction_after_noise(noise) -> None:
    chain = Chain([Servo(BY_NAME["XM430-W350"], 1, lambda t: 0.0)])
    chain.send(noise, 0.0, 1_000_000)
    assert chain.send(PACKETS2.read(1, 132, 4), 1.0, 1_000_000)


def test_corrupt_packet_rarely_passes_the_checksum() -> None:
    rng = Random(1)
    fault, packet, passed = corrupt(4), status_packet(2, 1, 0, bytes(range(16))), 0
    for _ in range(20_000):
        wrong = fault(Reply(1, 0.0, packet), rng).data
        try:
            passed += wrong != packet and PACKETS2.take(wrong, 0) is not None
        except Garbled:
            continue
    assert passed <= 5


@pytest.mark.parametrize("model", [m for m in MODELS if m.protocol == 2], ids=lambda model: model.name)
def test_addresses_and_units_match_sdk_control_tables(model) -> None:
    tables = files("dynamixel_easy_sdk") / "control_table"
    names = dict(line.split("\t")[:2] for line in (tables / "dynamixel.model").read_text().splitlines()[1:])
    text = (tables / names[str(model.number)].strip()).read_text()
    rows = [line.split("\t") for line in text.splitlines()]
    places = {row[2]: (int(row[0]), int(row[1])) for row in rows if len(row) == 3 and row[0].isdigit()}
    ours = {
        "Torque Enable": "torque",
        "Status Return Level": "status_return",
        "Hardware Error Status": "hardware_error",
        "Realtime Tick": "tick",
        "Moving": "moving",
        "Present Velocity": "velocity",
        "Present Position": "position",
        "Goal Position": "goal",
        "Present Input Voltage": "voltage",
        "Present Temperature": "temperature",
        "Homing Offset": "homing_offset",
        "Drive Mode": "drive_mode",
        "Operating Mode": "operating_mode",
        "Return Delay Time": "return_delay",
        "Firmware Version": "firmware",
    }
    for theirs, name in ours.items():
        register = model.layout[name]
        assert places[theirs] == (register.address, register.size), theirs
    assert (model.current_unit is not None) == ("Present Current" in places)
    values = {row[0]: int(row[1]) for row in rows if row[0].startswith("value_of")}
    span = values["value_of_max_radian_position"] - values["value_of_min_radian_position"]
    assert model.ticks_per_turn == span + (1 if values["value_of_min_radian_position"] == 0 else 0)


@pytest.mark.parametrize("baud", [57600, 1_000_000, 3_000_000])
@pytest.mark.parametrize("name", ["XM430-W350", "AX-12A"])
def test_a_baud_register_means_its_rate(name, baud) -> None:
    layout = BY_NAME[name].layout
    if layout.protocol == 2 or baud <= 1_000_000:
        assert baud_of(layout, baud_value(layout, baud)) == pytest.approx(baud, rel=0.03)
