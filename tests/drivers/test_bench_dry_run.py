"""The servos of a configuration on a bench, and the faults that are asked for."""

from __future__ import annotations

import math
from pathlib import Path
from random import Random

import numpy as np
import pytest

from drivers.bench.device import Reply
from drivers.dynamixel.bench.asked_faults import KINDS, ON_THE_WIRE, AskedFault, WireFaults
from drivers.dynamixel.bench.dry_run import DryRun
from drivers.bench.motion import played, swinging
from drivers.dynamixel.bench.through_servos import ThroughServos
from drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from drivers.dynamixel.joints import DynamixelJoints
from interfaces.clock import SystemClock
from interfaces.errors import ConfigError, SourceError
from interfaces.records import JointReading

JOINTS = ("waist", "shoulder", "elbow")
LIMITS = [(-3.0, 3.0)] * 3
CONFIG = DynamixelConfig(
    {"arm": BusConfig("elsewhere", latency_ms=20.0)},
    (
        ServoConfig("waist", 1, "XM430-W350"),
        ServoConfig("shoulder", 2, "XM430-W350", direction=-1),
        ServoConfig("elbow", 5, "MX-28(2.0)", zero_ticks=1000),
    ),
)
TICK = 2 * math.pi / 4096
POSE = (0.5, -0.25, 1.0)


def standing(tmp_path: Path, *faults: str, config: DynamixelConfig = CONFIG, seed: int = 0) -> DryRun:
    asked = [AskedFault.parsed(fault, JOINTS) for fault in faults]
    angles = {joint: lambda _, q=q: q for joint, q in zip(JOINTS, POSE, strict=True)}
    links = {name: tmp_path / name for name in config.buses}
    return DryRun(config, angles, links, faults=asked, seed=seed)


def reading(bench: DryRun) -> JointReading:
    with DynamixelJoints(bench.config, JOINTS, SystemClock(), limits=LIMITS) as joints:
        for _ in range(100):
            told = joints.read(0.1)
            if told is not None:
                return told
    raise AssertionError("no reading came")


# --- the configured servos


def test_the_driver_reads_the_angles_that_the_bench_was_given(tmp_path) -> None:
    with standing(tmp_path) as bench:
        assert reading(bench).q == pytest.approx(POSE, abs=TICK)


def test_each_bus_has_a_port_of_its_own(tmp_path) -> None:
    servos = (*CONFIG.servos[:2], ServoConfig("elbow", 1, "XL330-M288", bus="hand"))
    servos = tuple(ServoConfig(s.joint, s.id, s.model, bus=s.bus or "arm", direction=s.direction) for s in servos)
    two = DynamixelConfig({"arm": BusConfig("a", latency_ms=20.0), "hand": BusConfig("b", latency_ms=20.0)}, servos)
    with standing(tmp_path, config=two) as bench:
        assert reading(bench).q == pytest.approx(POSE, abs=TICK)
        assert {path.name for path in tmp_path.iterdir()} == {"arm", "hand"}


def test_nothing_is_left_of_a_bench_that_has_ended(tmp_path) -> None:
    with standing(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_servo_at_another_rate_is_missing(tmp_path) -> None:
    with standing(tmp_path, "baud@elbow") as bench, pytest.raises(SourceError, match=r"elbow +5 .* no answer"):
        reading(bench)


def test_two_servos_of_one_id_are_refused(tmp_path) -> None:
    with standing(tmp_path, "double@waist") as bench, pytest.raises(SourceError, match=r"waist +1 .* garbled"):
        reading(bench)


def test_an_overload_is_in_the_servo(tmp_path) -> None:
    assert standing(tmp_path, "overload@elbow").servo("elbow").hardware_error == 0x20


def test_an_unplugged_port_is_gone_and_comes_back(tmp_path) -> None:
    with standing(tmp_path, "unplug") as bench:
        events = bench.events()
        _, _, unplug = next(events)
        _, _, plug_in = next(events)
        unplug()
        assert not (tmp_path / "arm").is_symlink()
        plug_in()
        assert reading(bench).q == pytest.approx(POSE, abs=TICK)


def test_a_glitch_is_over_with_the_next_event(tmp_path) -> None:
    bench = standing(tmp_path, "glitch@elbow")
    events = bench.events()
    next(events)[2]()
    assert bench.servo("elbow").glitch_ticks != 0
    next(events)[2]()
    assert bench.servo("elbow").glitch_ticks == 0


def test_a_power_cycle_loses_what_stands_in_ram(tmp_path) -> None:
    bench = standing(tmp_path, "power-cycle", "torque@waist")
    assert bench.servo("waist")["torque"] == 1
    next(bench.events())[2]()
    assert bench.servo("waist")["torque"] == 0


def test_a_bench_without_faults_has_no_events(tmp_path) -> None:
    assert list(standing(tmp_path).events()) == []


# --- what is asked for


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_can_be_asked_for(kind) -> None:
    alone = kind in (*ON_THE_WIRE, "unplug", "power-cycle")
    assert AskedFault.parsed(kind if alone else f"{kind}@elbow", JOINTS).kind == kind


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("layt", "unknown fault 'layt'. Did you mean 'late'?"),
        ("late@elbo", "unknown joint 'elbo'. Did you mean 'elbow'?"),
        ("overload", "it is of one joint. Name it, as in overload@waist"),
        ("unplug@elbow", "it strikes all servos. Give unplug alone"),
        ("overload@elbow=0.5", "it has no share. Give overload@elbow alone"),
        ("late=2", "'2' is no share"),
        ("late=often", "'often' is no share"),
    ],
)
def test_what_is_no_fault_is_said_to_be_none(text, said) -> None:
    with pytest.raises(ConfigError) as caught:
        AskedFault.parsed(text, JOINTS)
    assert f"--fault {text}: " in str(caught.value)
    assert said in str(caught.value)


def test_a_fault_of_a_joint_strikes_each_of_its_answers_and_no_other() -> None:
    faults = WireFaults([(5, 1.0, ON_THE_WIRE["mute"])], Random(1))
    assert [bool(faults(Reply(id, 0.0, b"12")).data) for id in (5, 1, 5, 2)] == [False, True, False, True]


def test_a_share_is_that_of_the_answers_that_suffer() -> None:
    faults = WireFaults([(None, 0.1, ON_THE_WIRE["mute"])], Random(1))
    struck = sum(not faults(Reply(1, 0.0, b"12")).data for _ in range(5000))
    assert 0.08 < struck / 5000 < 0.12


# --- motion


def test_a_path_is_played_to_its_end_and_back() -> None:
    (joint,) = played(np.array([[0.0], [1.0], [3.0]]), rate_hz=10.0, begin_s=5.0)
    assert [joint(5.0 + t) for t in (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)] == pytest.approx([0, 0.5, 1, 3, 1, 0, 1])


def test_a_swing_stays_within_the_limits() -> None:
    limits = [(-0.2, 1.0), (0.0, 0.1), (-math.inf, math.inf)]
    for joint, (lower, upper) in zip(swinging(limits, 0.0), limits, strict=True):
        angles = [joint(t) for t in np.linspace(0, 100, 1000)]
        assert lower < min(angles) < max(angles) < upper


# --- in the simulation's place


class Scripted:
    """Gives prepared readings."""

    joints = JOINTS

    def __init__(self, poses) -> None:
        self._readings = [JointReading(k / 10, np.array(pose)) for k, pose in enumerate(poses)]

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        pass

    def read(self, timeout_s: float) -> JointReading | None:
        return self._readings.pop(0) if self._readings else None


def test_readings_through_servos_keep_their_times_and_have_the_servos_resolution() -> None:
    poses = [(0.5 + 1e-3 * k, 0.1, -0.2 - 2e-3 * k) for k in range(20)]
    with ThroughServos(Scripted(poses), CONFIG, SystemClock(), LIMITS) as source:
        seen = [source.read(1.0) for _ in poses]
        assert source.read(1.0) is None
    assert [told.t for told in seen if told] == [k / 10 for k in range(20)]
    q = np.array([told.q for told in seen if told])
    assert np.abs(q - poses).max() <= TICK / 2 + 1e-12
    assert q / TICK == pytest.approx(np.round(q / TICK), abs=1e-9)


def test_readings_through_servos_can_be_opened_again() -> None:
    source = ThroughServos(Scripted([POSE] * 2), CONFIG, SystemClock(), LIMITS)
    for _ in range(2):
        with source:
            told = source.read(1.0)
            assert told is not None
            assert told.q == pytest.approx(POSE, abs=TICK)
