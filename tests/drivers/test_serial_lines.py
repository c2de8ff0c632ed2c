"""Own encoders: lines, the driver over its emulator in virtual time, and the sketch for a real board."""

from __future__ import annotations

import logging
import math
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from servo_arm import swing
from virtual_port import VirtualClock, VirtualPort, at_once
from wire_faults import Planned, storm

from bodyschema.drivers.emulator.device import Reply
from bodyschema.drivers.emulator.faults import corrupt, garbage, half, late, mute, wrong_checksum
from bodyschema.drivers.serial_lines.board import Board
from bodyschema.drivers.serial_lines.config import EncoderConfig, SerialLinesConfig
from bodyschema.drivers.serial_lines.emulator.board import EncoderBoard
from bodyschema.drivers.serial_lines.joints import SerialLineJoints
from bodyschema.drivers.serial_lines.lines import (
    INITIAL,
    LONGEST,
    SEQUENCES,
    VERSION,
    GarbledLine,
    Header,
    Reading,
    crc_ccitt,
    parse,
    with_checksum,
)
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.records import JointReading

TICK = 2 * math.pi / 4096
HEADER = "H,1,7,2,shoulder,4096,elbow,16384"
SKETCH = Path(__file__).parents[2] / "examples" / "as5600" / "as5600.ino"
FAULTS = [mute, late(0.05), wrong_checksum, corrupt(), half, garbage]
PIECES = st.lists(
    st.one_of(
        st.binary(max_size=60),
        st.sampled_from([b"\n", b"*", b",", with_checksum(HEADER)]),
        st.builds(lambda n, t, a: with_checksum(f"{n},{t},{a},-5"), *[st.integers(0, 2**17)] * 3),
    ),
    max_size=20,
)


class BoardArm:
    """A driver connected to an emulator."""

    def __init__(
        self,
        paths=None,
        *,
        ticks: int = 4096,
        baud: int = 115_200,
        latency_s: float = 0.0,
        drift: float = 0.0,
        encoders: Mapping[str, object] = {},
        limits=None,
        last_pose=None,
        seed: int = 0,
        rate_hz: float = 200.0,
        **settings,
    ) -> None:
        self.clock, rng = VirtualClock(), Random(seed)
        self.paths = [swing(k) for k in range(3)] if paths is None else list(paths)
        self.names = tuple(f"joint{k}" for k in range(1, len(self.paths) + 1))
        self.faults = Planned(rng)
        angles = {name: (ticks, path) for name, path in zip(self.names, self.paths, strict=True)}
        self.board = EncoderBoard(angles, begun_s=97.0, rate_hz=rate_hz, drift=drift, faults=self.faults)
        jitter = (lambda: rng.uniform(0, latency_s)) if latency_s else at_once
        self.port = VirtualPort(self.board, self.clock, baud, inwards=jitter)
        entries = tuple(EncoderConfig(name, **encoders) for name in self.names)  # pyright: ignore[reportArgumentType]
        self.joints = SerialLineJoints(
            SerialLinesConfig("emulator", entries, baud, **settings),
            self.names,
            self.clock,
            limits=[(-2.0, 2.0)] * len(self.paths) if limits is None else limits,
            last_pose=last_pose,
            open_port=lambda *_: self.port,
        )

    def error(self, reading) -> float:
        """Return the largest error of the reading's angles against the truth at its time [rad]."""
        return max(abs(q - path(reading.t)) for q, path in zip(reading.q, self.paths, strict=True))

    def read(self, count: int = 1) -> list[JointReading]:
        found = []
        while len(found) < count:
            reading = self.joints.read(0.1)
            if reading is not None:
                found.append(reading)
        return found


# --- lines


def test_the_checksum_is_that_of_the_standard() -> None:
    assert crc_ccitt(b"123456789") == 0x29B1


def test_a_header_and_a_reading_are_taken_apart() -> None:
    assert parse(with_checksum(HEADER)[:-1]) == Header(7, {"shoulder": 4096, "elbow": 16384})
    assert parse(with_checksum("65535,4294967295,12,-7,-")[:-1]) == Reading(65535, 2**32 - 1, (12, -7, None))


@pytest.mark.parametrize(
    "content",
    [
        "H,2,7,1,a,4096",
        "H,1,70000,1,a,4096",
        "H,1,7,2,a,4096",
        "H,1,7,2,a,4096,a,4096",
        "H,1,7,1,a,1",
        "H,1,7,1,,4096",
        "1,2",
        "65536,1,1",
        "1,4294967296,1",
        "1,1,1.5",
        "1,1,",
        "-1,1,1",
        "a,1,1",
    ],
)
def test_valid_checksum_with_invalid_content_is_refused(content) -> None:
    with pytest.raises(GarbledLine):
        parse(with_checksum(content)[:-1])


@given(st.binary(max_size=80))
def test_any_bytes_are_a_line_or_refused(data) -> None:
    try:
        said = parse(data)
    except GarbledLine:
        return
    assert isinstance(said, Header | Reading)


@given(PIECES)
@example([b"\n", with_checksum(HEADER), *(with_checksum(f"{seq},{10 * seq},1,-5") for seq in (7, 6, 7, 9))])
def test_accepted_readings_were_sent_and_are_in_order(pieces) -> None:
    board, said = Board(0.0, 0.0), b"".join(pieces)
    for k, piece in enumerate(pieces):
        board.hear(piece, 100.0 + k * 1e-3)
    seen = []
    while (timed := board.next()) is not None:
        words = ["-" if tick is None else str(tick) for tick in timed.reading.ticks]
        assert with_checksum(",".join((str(timed.reading.seq), str(timed.reading.t_us), *words))) in said
        seen.append(timed.reading.seq)
    assert board.header is not None or not seen
    assert len(seen) == board.counts.lines
    assert all(0 < (later - earlier) % SEQUENCES < SEQUENCES // 2 for earlier, later in pairwise(seen))


def test_a_flood_without_line_feeds_is_forgotten() -> None:
    board = Board(0.0, 0.0)
    board.hear(b"\n", 100.0)
    for _ in range(100):
        board.hear(b"a" * LONGEST, 100.0)
    board.hear(b"\n" + with_checksum(HEADER), 101.0)
    assert board.counts.garbled == 1
    assert board.header is not None


# --- readings


@pytest.mark.parametrize("drift", [0.0, 50e-6, 5e-3])
def test_reading_matches_each_joint_at_its_time(drift) -> None:
    with (arm := BoardArm(latency_s=2e-3, drift=drift)).joints:
        arm.read(600)  # by then the rate of the board's clock is known
        assert max(arm.error(reading) for reading in arm.read(2000)) < TICK / 2 + 0.9 * 0.5e-3


def test_times_match_measurements_to_half_a_millisecond() -> None:
    steep = [lambda t: 8.0 * (t - 100.0)]  # 8 rad/s show the time to 0.1 ms
    with (arm := BoardArm(steep, ticks=16384, latency_s=4e-3, limits=[(-1e9, 1e9)], drift=1e-4)).joints:
        readings = arm.read(2000)[400:]
    off = [abs(reading.q[0] / 8.0 + 100.0 - reading.t) for reading in readings]
    turns = [min(o % (2 * math.pi / 8), -o % (2 * math.pi / 8)) for o in off]
    assert np.percentile(turns, 99) < 0.5e-3


def time_error(reading: JointReading) -> float:
    """Return the time error [s] of a reading of `STEEP`, modulo a turn of it."""
    turn_s = 2 * math.pi / 8.0
    return (reading.t - reading.q[0] / 8.0 - 100.0 + turn_s / 2) % turn_s - turn_s / 2


STEEP = (lambda t: 8.0 * (t - 100.0),)  # 8 rad/s show the time to 0.05 ms, with 16,384 ticks


def steep_arm(**settings) -> BoardArm:
    return BoardArm(STEEP, ticks=16384, limits=[(-1e9, 1e9)], **settings)


@pytest.mark.parametrize("drift", [0.0, pytest.param(1e-4, marks=pytest.mark.soak), -0.01])
@pytest.mark.parametrize("latency_s", [0.0, pytest.param(4e-3, marks=pytest.mark.soak), 16e-3])
def test_the_time_sigma_holds_from_the_first_reading(drift, latency_s) -> None:
    with (arm := steep_arm(latency_s=latency_s, drift=drift)).joints:
        readings = arm.read(2000)
    assert max(abs(time_error(reading)) - 3 * reading.t_sigma for reading in readings) < 0.1e-3


@pytest.mark.parametrize("latency_s", [0.0, 4e-3])
def test_time_sigma_is_submillisecond_with_known_clock(latency_s) -> None:
    with (arm := steep_arm(latency_s=latency_s, drift=1e-4)).joints:
        assert 0.3e-3 < arm.read(600)[-1].t_sigma < 1e-3


def test_lines_delayed_at_opening_do_not_bias_times() -> None:
    arm = steep_arm()
    begin, end = arm.clock.now(), arm.clock.now() + 0.25
    arm.faults.add(0, lambda reply, _: replace(reply, start=end) if begin < reply.start < end else reply)
    with arm.joints:
        readings = arm.read(600)
    assert max(abs(time_error(reading)) - 3 * reading.t_sigma for reading in readings) < 0.1e-3
    assert max(reading.t_sigma for reading in readings) < 5e-3


def test_delayed_line_gets_its_measurement_time() -> None:
    with (arm := steep_arm()).joints:
        arm.read(600)
        arm.faults.add(0, lambda reply, _: replace(reply, start=reply.start + 15e-3), 3)
        assert max(abs(time_error(reading)) for reading in arm.read(10)) < 1e-3


def test_the_delay_before_the_line_is_taken_off() -> None:
    with (late_arm := BoardArm(delay_ms=3.0)).joints, (arm := BoardArm()).joints:
        assert arm.read(10)[-1].t - late_arm.read(10)[-1].t == pytest.approx(3e-3, abs=1e-6)


def test_direction_and_zero_come_from_the_configuration() -> None:
    arm = BoardArm([lambda t: 500 * TICK], encoders={"direction": -1, "zero_ticks": 100})
    with arm.joints:
        assert arm.read()[0].q.tolist() == [-400 * TICK]


@pytest.mark.parametrize("ticks", [4096, 1024, 3600])
def test_positions_go_on_across_turns(ticks) -> None:
    with (arm := BoardArm([lambda t: 4.0 * (t - 97.0)], ticks=ticks, limits=[(-1e9, 1e9)], last_pose=[12.0])).joints:
        readings = arm.read(1500)
    assert max(arm.error(reading) for reading in readings) < 2 * math.pi / ticks + 4.0 * 1e-3
    assert readings[-1].q[0] > 5 * 2 * math.pi


def test_joint_with_ambiguous_turn_is_named() -> None:
    arm = BoardArm([lambda t: 2.5], limits=[(-9.0, 9.0)], last_pose=[0.0])
    said = r"joint 'joint1' \(encoder 'joint1'\) was at 0° and .*lost"
    with pytest.raises(SourceLost, match=said), arm.joints:
        pass


# --- boards present


def test_missing_and_mismatched_encoders_share_one_table() -> None:
    arm = BoardArm(encoders={"ticks_per_turn": 4096})
    arm.board.encoders = {"joint1": (4096, swing(0)), "joint2": (1024, swing(1)), "elbow": (4096, swing(2))}
    with pytest.raises(SourceError) as refusal, arm.joints:
        pass
    assert str(refusal.value).splitlines() == [
        "the encoders on emulator are not those of robot.toml:",
        "  joint   encoder  expected    found",
        "  joint1  joint1   4096 ticks  4096 ticks",
        "  joint2  joint2   4096 ticks  1024 ticks",
        "  joint3  joint3   4096 ticks  not announced",
        "  announced are: joint1, joint2, elbow",
    ]


@pytest.mark.parametrize(
    ("fault", "said"), [(mute, "sends nothing"), (wrong_checksum, "sends no header: compare baud")]
)
def test_board_without_header_is_refused_with_the_symptom(fault, said) -> None:
    arm = BoardArm()
    arm.faults.add(0, lambda reply, rng: fault(replace(reply, data=reply.data.replace(b"\n", b"")), rng))
    with pytest.raises(SourceLost, match=said), arm.joints:
        pass


def test_record_holds_the_settings_of_each_encoder() -> None:
    with (arm := BoardArm()).joints:
        assert arm.joints.record[1]["encoder"] == "joint2"
        assert arm.joints.record[1]["rad_per_tick"] == TICK


# --- faults


@pytest.mark.parametrize("fault", FAULTS, ids=range(len(FAULTS)))
def test_a_fault_costs_a_reading_and_nothing_else(fault) -> None:
    with (arm := BoardArm()).joints:
        arm.read(10)
        for _ in range(10):
            arm.faults.add(0, fault, 1)
            assert max(arm.error(reading) for reading in arm.read(20)) < 2 * TICK
    assert arm.joints.epoch == 1


def test_gaps_and_garbled_lines_are_counted() -> None:
    with (arm := BoardArm()).joints:
        arm.read(10)
        arm.faults.add(0, mute, 3)
        arm.read(10)
        arm.faults.add(0, wrong_checksum, 1)
        arm.read(10)
        counts = arm.joints.counts
        assert (counts.missing, counts.garbled) == (3 + 2, 1)  # without its line feed one takes the next with it


def test_repeated_line_is_accepted_once() -> None:
    with (arm := BoardArm()).joints:
        arm.read(10)
        arm.faults.add(0, lambda reply, _: Reply(0, reply.start, reply.data + reply.data), 1)
        arm.read(10)
        assert arm.joints.counts.out_of_order == 1


def test_a_board_that_was_restarted_is_another_epoch() -> None:
    arm = BoardArm()
    with arm.joints:
        arm.read(300)
        arm.board.reboot(arm.clock.now())
        with pytest.raises(SourceLost, match="the board was restarted"):
            arm.read(100)
    with arm.joints:
        assert arm.error(arm.read()[0]) < 2 * TICK
    assert arm.joints.epoch == 2


def test_valueless_encoder_stops_readings_and_warns_once(caplog) -> None:
    with caplog.at_level(logging.WARNING), (arm := BoardArm()).joints:
        arm.read(10)
        arm.board.failing.add("joint2")
        while arm.joints.read(0.02) is not None:
            continue
        assert arm.joints.health == (
            "joint 'joint2': its encoder has no value: look at its cable, and at the magnet's distance",
        )
        arm.board.failing.clear()
        arm.read(10)
        assert arm.joints.health == ()
    assert len(caplog.messages) == 1


def test_persistently_valueless_encoder_is_a_loss() -> None:
    arm = BoardArm()
    with arm.joints:
        arm.read(10)
        arm.board.failing.add("joint2")
        with pytest.raises(SourceLost, match="joint 'joint2': its encoder has no value"):
            arm.read(100)


def test_silence_is_a_loss() -> None:
    arm = BoardArm()
    with arm.joints:
        arm.read(10)
        arm.faults.add(0, mute)
        with pytest.raises(SourceLost, match="no line"):
            arm.read(100)


def test_an_encoder_s_glitch_is_not_believed() -> None:
    with (arm := BoardArm()).joints:
        arm.read(10)
        arm.board.glitch_ticks["joint2"] = 300
        while arm.joints.dropped == 0:  # lines sent before are right
            reading = arm.joints.read(0.01)
            assert reading is None or arm.error(reading) < 2 * TICK
        arm.board.glitch_ticks.clear()
        assert max(arm.error(reading) for reading in arm.read(20)) < 2 * TICK


def test_fault_storm_yields_no_wrong_reading() -> None:
    arm = BoardArm(seed=5, latency_s=1e-3)
    with arm.joints:
        arm.board.faults = struck = storm(0.02, Random(6))
        begun = arm.board.lines
        readings = arm.read(6_000)
    assert sum(struck.struck.values()) > 60
    assert max(arm.error(reading) for reading in readings) < 2 * TICK
    assert len(readings) / (arm.board.lines - begun) > 0.95


# --- the sketch


def sketch_constant(name: str) -> int:
    found = re.search(rf"\b{name} = (\w+);", SKETCH.read_text())
    assert found is not None
    return int(found[1], 0)


def test_the_sketch_has_the_driver_s_constants() -> None:
    assert sketch_constant("CRC_POLYNOMIAL") == 0x1021
    assert sketch_constant("CRC_INITIAL") == INITIAL
    assert sketch_constant("VERSION") == VERSION
    assert sketch_constant("BAUD") == SerialLinesConfig("x", ()).baud


HARNESS = """
#include <stdio.h>
#include <stdlib.h>
#include <string>
#define ARDUINO 1
using byte_t = unsigned char;
unsigned int now_us = 4294960000u;
struct Port {
  void begin(unsigned long) {}
  void write(char c) { putchar(c); }
  int available() { return 0; }
  int read() { return -1; }
} Serial;
struct Bus {
  int at = 0, channel = 0, place = 0;
  void begin() {}
  void setClock(long) {}
  void beginTransmission(byte_t address) { at = address; }
  void write(byte_t value) { if (at == 0x70) channel = value; }
  int endTransmission(bool = true) { return 0; }
  int requestFrom(byte_t, byte_t count) { place = 0; return count; }
  int read() {
    const int data[3] = {channel == 2 ? 0x00 : 0x20, 0xF1, channel};
    return data[place++];
  }
} Wire;
unsigned long micros() { return now_us += 10; }
unsigned long millis() { return now_us / 1000; }
int analogRead(int) { return 5; }
const int A0 = 0;
void ultoa(unsigned long number, char* text, int) { snprintf(text, 12, "%lu", number); }
#include "sketch.inc"
int main() { setup(); for (int k = 0; k < 5000; k++) loop(); }
"""


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler; to run it: apt-get install g++")
def test_driver_parses_the_lines_of_the_sketch(tmp_path) -> None:
    text = re.sub(r"#include <(Arduino|Wire)\.h>", "", SKETCH.read_text())
    (tmp_path / "sketch.inc").write_text(text)
    (tmp_path / "harness.cpp").write_text(HARNESS)
    subprocess.run(["g++", "-o", "said", "harness.cpp"], cwd=tmp_path, check=True, timeout=300)
    said = subprocess.run([tmp_path / "said"], capture_output=True, check=True, timeout=300).stdout.splitlines()
    lines = [parse(line) for line in said]
    assert isinstance(lines[0], Header)
    assert lines[0].encoders == {"shoulder": 4096, "elbow": 4096, "wrist": 4096}
    readings = [line for line in lines if isinstance(line, Reading)]
    assert [reading.seq for reading in readings] == list(range(len(readings)))
    assert {reading.ticks for reading in readings} == {(0x101, None, 0x104)}
