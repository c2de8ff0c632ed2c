"""Turns, speeds and device clocks of any device."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.drivers.device_clock import DeviceClock, StreamClock
from bodyschema.drivers.serial_line import SerialLineSettings, adapter_latency_s
from bodyschema.drivers.speed_gate import SpeedGate, nearest_turn


@given(st.integers(-(10**6), 10**6), st.floats(-1e6, 1e6))
def test_nearest_turn_adds_whole_turns_to_within_half(raw, near) -> None:
    there = nearest_turn(raw, near, 4096)
    assert abs(there - near) <= 2048 + 1e-6
    assert (there - raw) % 4096 == 0


def test_sensor_without_turns_is_kept_unchanged() -> None:
    assert nearest_turn(1000, 0.0, None) == 1000


def test_gate_rejects_only_impossible_joint_motion() -> None:
    gate = SpeedGate([10.0, 10.0], [0.1, 0.1])
    assert gate.offer(0.0, [0.0, 0.0]) is None
    assert gate.offer(0.1, [1.05, 0.0]) is None
    assert gate.offer(0.2, [1.05, 1.2]) == 1
    assert gate.offer(0.3, [1.05, 0.0]) is None


def test_only_agreeing_positions_count_as_a_jump() -> None:
    for agree in (True, False):
        gate = SpeedGate([1.0], [0.1])
        gate.offer(0.0, [0.0])
        for k in range(1, 7):
            assert gate.offer(k * 0.01, [50.0 if agree else 50.0 * k]) == 0
        assert gate.jumped is agree


@pytest.mark.parametrize("drift", [50e-6, -0.01, 0.01])
def test_device_clock_narrows_the_event_time_interval(drift) -> None:
    rng, clock, widths = Random(3), DeviceClock(1e-3, 32768), []
    offset = 57.1234
    for k in range(20_000):  # through several wraps of the stamp
        true = 100.0 + k * 5.31e-3
        stamp = int((true * (1 + drift) - offset) / 1e-3) % 32768
        between = clock.narrow(true - rng.uniform(0, 3e-3), true + rng.uniform(0, 3e-3), stamp)
        assert between is not None
        if k >= 300:  # by then the rate is known
            assert between[0] - 3e-4 <= true <= between[1] + 3e-4
        widths.append(between[1] - between[0])
    assert np.mean(widths[1000:]) < 1.8e-3  # of 3 ms


@pytest.mark.parametrize("late_s", [0.003, 0.02, 1.0, 20.0])
def test_event_of_another_time_is_refused_harmlessly(late_s) -> None:
    clock = DeviceClock(1e-3, 32768)
    for k in range(300):
        t = 10.0 + k * 5.3e-3
        assert clock.narrow(t - 1e-4, t + 1e-4, int(t / 1e-3) % 32768) is not None
    t = 10.0 + 300 * 5.3e-3
    assert clock.narrow(t - 1e-4, t + 1e-4, int((t - late_s) / 1e-3) % 32768) is None
    assert clock.narrow(t - 1e-4, t + 1e-4, int(t / 1e-3) % 32768) is not None


def test_adapter_latency_comes_from_system_if_known(tmp_path) -> None:
    (tmp_path / "ttyUSB7").write_text("16\n")
    assert adapter_latency_s("/dev/ttyUSB7", str(tmp_path / "{}")) == 16e-3
    assert adapter_latency_s("/dev/ttyACM0", str(tmp_path / "{}")) == SerialLineSettings.default_latency_s


@pytest.mark.parametrize("held_s", [1e-3, 16e-3])
@pytest.mark.parametrize("drift", [0.0, 50e-6, -0.01, 0.01])
def test_stream_clock_learns_offset_and_rate_through_wrap(drift, held_s) -> None:
    rng, clock, off = Random(3), StreamClock(1e-6, 2**32), []
    for k in range(6000):
        true = 100.0 + k * 5e-3
        stamp = int((true * (1 + drift) + 4175) / 1e-6) % 2**32  # wraps in between
        t = clock.time(true + rng.uniform(0, held_s), stamp)
        assert t is not None
        off.append(abs(t - true))
    assert max(off[:600]) < held_s + 3e-3
    assert np.percentile(off[600:], 99) < 0.25e-3
    assert clock.rate == pytest.approx(1 / (1 + drift), abs=5e-5)


@pytest.mark.parametrize("late_s", [0.6, 20.0, -0.05, -20.0])
def test_stream_stamp_of_another_time_is_refused_harmlessly(late_s) -> None:
    clock = StreamClock(1e-6, 2**32)
    for k in range(600):
        t = 50.0 + k * 5e-3
        assert clock.time(t, int(t / 1e-6)) == pytest.approx(t, abs=2e-6)
    t = 50.0 + 600 * 5e-3
    assert clock.time(t, int((t - late_s) / 1e-6)) is None
    assert clock.time(t, int(t / 1e-6)) == pytest.approx(t, abs=2e-6)


def test_stream_starting_with_a_backlog_soon_converges() -> None:
    clock, t = StreamClock(1e-6, 2**32), None
    for k in range(400):
        true = 50.0 + k * 5e-3
        t = clock.time(max(true, 50.3), int(true / 1e-6))
        assert t is not None
    assert t == pytest.approx(51.995, abs=1e-4)
