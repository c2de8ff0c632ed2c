"""The servos of a configuration on an emulator, and the requested faults."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
import pytest

from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.arm import KINDS, DynamixelArm
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.powered_config import GazeConfig
from bodyschema.drivers.emulator.device import Reply
from bodyschema.drivers.emulator.dry_run import DryRun
from bodyschema.drivers.emulator.faults import FaultKinds, FaultSpec, WireFaults
from bodyschema.drivers.emulator.servo_arm import played, swinging
from bodyschema.drivers.emulator.through_driver import Behind, ThroughDriver
from bodyschema.drivers.feetech.config import BusConfig as FeetechBus
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.feetech.emulator.arm import KINDS as FEETECH_KINDS
from bodyschema.drivers.feetech.emulator.arm import FeetechArm
from bodyschema.drivers.feetech.joints import FeetechJoints
from bodyschema.drivers.serial_lines.config import EncoderConfig, SerialLinesConfig
from bodyschema.drivers.serial_lines.emulator.arm import KINDS as LINE_KINDS
from bodyschema.drivers.serial_lines.emulator.arm import EncoderArm
from bodyschema.drivers.serial_lines.joints import SerialLineJoints
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, SourceError
from bodyschema.interfaces.records import JointReading

JOINTS = ("waist", "shoulder", "elbow")
LIMITS = [(-3.0, 3.0)] * 3
ENTRIES = ((1, "XM430-W350"), (2, "XM430-W350"), (5, "MX-28(2.0)"))
TURNED = ({}, {"direction": -1}, {"zero_ticks": 1000})


def dynamixel(ports: tuple[str, ...] = ("arm",), buses: tuple[str, ...] = ("arm",) * 3) -> DynamixelConfig:
    servos = (
        ServoConfig(joint, id, model, bus=bus, **how)
        for joint, (id, model), bus, how in zip(JOINTS, ENTRIES, buses, TURNED, strict=True)
    )
    return DynamixelConfig({port: BusConfig("elsewhere", latency_ms=20.0) for port in ports}, tuple(servos))


CONFIG = dynamixel()
FEETECH_CONFIG = FeetechConfig(
    {"arm": FeetechBus("elsewhere", latency_ms=20.0)},
    (
        ServoConfig("waist", 1, "STS3215"),
        ServoConfig("shoulder", 2, "STS3250", direction=-1),
        ServoConfig("elbow", 5, "STS3215", zero_ticks=1000),
    ),
)
LINES_CONFIG = SerialLinesConfig(
    "elsewhere",
    (
        EncoderConfig("waist"),
        EncoderConfig("shoulder", encoder="a2", direction=-1),
        EncoderConfig("elbow", zero_ticks=1000, ticks_per_turn=16384),
    ),
)
# For each vendor: its emulator, the configured arm, the kinds of faults, and the driver.
MAKES: dict[str, tuple[Any, Any, FaultKinds, Any]] = {
    "Dynamixel": (DynamixelArm, CONFIG, KINDS, DynamixelJoints),
    "Feetech": (FeetechArm, FEETECH_CONFIG, FEETECH_KINDS, FeetechJoints),
    "serial lines": (EncoderArm, LINES_CONFIG, LINE_KINDS, SerialLineJoints),
}
EACH = pytest.mark.parametrize("make", MAKES)
SERVOS = pytest.mark.parametrize("make", ["Dynamixel", "Feetech"])
TICK = 2 * math.pi / 4096
POSE = (0.5, -0.25, 1.0)


def standing(tmp_path: Path, make: str, *faults: str, config: Any = None, seed: int = 0) -> DryRun:
    arm_of, usual, kinds, _ = MAKES[make]
    asked = [FaultSpec.parsed(fault, JOINTS, kinds) for fault in faults]
    angles = {joint: lambda _, q=q: q for joint, q in zip(JOINTS, POSE, strict=True)}
    arm = arm_of(config or usual, angles, faults=asked, seed=seed)
    return DryRun(arm, {name: tmp_path / name for name in arm.devices}, faults=asked)


def reading(emulator: DryRun, make: str) -> JointReading:
    with MAKES[make][3](emulator.config, JOINTS, SystemClock(), limits=LIMITS) as joints:
        for _ in range(100):
            told = joints.read(0.1)
            if told is not None:
                return told
    raise AssertionError("no reading came")


# --- the configured servos


@EACH
def test_driver_reads_the_angles_given_to_emulator(make, tmp_path) -> None:
    with standing(tmp_path, make) as emulator:
        assert reading(emulator, make).q == pytest.approx(POSE, abs=TICK)
        assert emulator.arm.count > 0


def test_each_bus_has_a_port_of_its_own(tmp_path) -> None:
    two = dynamixel(("arm", "hand"), ("arm", "arm", "hand"))
    with standing(tmp_path, "Dynamixel", config=two) as emulator:
        assert reading(emulator, "Dynamixel").q == pytest.approx(POSE, abs=TICK)
        assert {path.name for path in tmp_path.iterdir()} == {"arm", "hand"}


@EACH
def test_ended_emulator_leaves_no_files(make, tmp_path) -> None:
    with standing(tmp_path, make):
        pass
    assert list(tmp_path.iterdir()) == []


@SERVOS
def test_a_servo_at_another_rate_is_missing(make, tmp_path) -> None:
    with standing(tmp_path, make, "baud@elbow") as emulator, pytest.raises(SourceError, match=r"elbow +5 .* no answer"):
        reading(emulator, make)


@SERVOS
def test_two_servos_of_one_id_are_refused(make, tmp_path) -> None:
    with standing(tmp_path, make, "double@waist") as emulator, pytest.raises(SourceError, match="waist"):
        reading(emulator, make)


def test_a_sensor_without_a_value_is_refused(tmp_path) -> None:
    with standing(tmp_path, "serial lines", "sensor@elbow") as emulator, pytest.raises(SourceError, match="'elbow'"):
        reading(emulator, "serial lines")


@pytest.mark.parametrize(("make", "register"), [("Dynamixel", "hardware_error"), ("Feetech", "status")])
def test_an_overload_is_in_the_servo(make, register, tmp_path) -> None:
    assert standing(tmp_path, make, "overload@elbow").arm.servo("elbow")[register] == 0x20


@EACH
def test_an_unplugged_port_is_gone_and_comes_back(make, tmp_path) -> None:
    with standing(tmp_path, make, "unplug") as emulator:
        events = emulator.events()
        _, _, unplug = next(events)
        _, _, plug_in = next(events)
        (link,) = tmp_path.iterdir()
        unplug()
        assert not link.is_symlink()
        plug_in()
        assert reading(emulator, make).q == pytest.approx(POSE, abs=TICK)


@SERVOS
def test_a_glitch_is_over_with_the_next_event(make, tmp_path) -> None:
    emulator = standing(tmp_path, make, "glitch@elbow")
    events = emulator.events()
    next(events)[2]()
    assert emulator.arm.servo("elbow").glitch_ticks != 0
    next(events)[2]()
    assert emulator.arm.servo("elbow").glitch_ticks == 0


@SERVOS
def test_power_cycle_clears_the_ram(make, tmp_path) -> None:
    emulator = standing(tmp_path, make, "power-cycle", "torque@waist")
    assert emulator.arm.servo("waist")["torque"] == 1
    next(emulator.events())[2]()
    assert emulator.arm.servo("waist")["torque"] == 0


def test_a_board_that_lost_its_power_says_so(tmp_path) -> None:
    emulator = standing(tmp_path, "serial lines", "power-cycle")
    board = emulator.arm.devices["board"]
    before = board.speak(board.speaks_at, 115_200)[0].data
    next(emulator.events())[2]()
    after = board.speak(board.speaks_at, 115_200)[0].data
    assert before.split(b"H,1,")[1].split(b",")[0] != after.split(b"H,1,")[1].split(b",")[0]


def test_emulator_without_faults_has_no_events(tmp_path) -> None:
    assert list(standing(tmp_path, "Dynamixel").events()) == []


# --- a head


GAZING = msgspec.structs.replace(CONFIG, gaze=GazeConfig(joints=("waist", "shoulder")))


def turning(*faults: str) -> DynamixelArm:
    """Return an arm whose joints all move with time, except those that its servos turn."""
    asked = [FaultSpec.parsed(fault, JOINTS, KINDS) for fault in faults]
    return DynamixelArm(GAZING, dict.fromkeys(JOINTS, lambda t: 0.1 * t), faults=asked, now=lambda: 2.0)


def test_gaze_joints_move_only_by_their_servos() -> None:
    arm = turning()
    waist, elbow = arm.servo("waist"), arm.servo("elbow")
    assert waist.angle(5.0) == pytest.approx(0.2)
    assert elbow.angle(5.0) - elbow.angle(4.0) == pytest.approx(0.1)
    waist["torque"], waist["goal"] = 1, waist.position(5.0) + 100
    assert waist.angle(5.01) < 0.2 + 100 * TICK
    assert waist.angle(6.0) == pytest.approx(0.2 + 100 * TICK, abs=TICK)


def test_head_with_initial_torque_stays_in_place() -> None:
    shoulder = turning("torque@shoulder").servo("shoulder")  # counts against the joint
    before = shoulder.angle(3.0)
    assert shoulder.angle(9.0) == pytest.approx(before, abs=TICK)


def test_a_turned_shaft_knows_where_it_was() -> None:
    waist = turning().servo("waist")
    waist.angle(3.0)
    waist["torque"], waist["goal"] = 1, waist.position(3.0) + 50
    waist.angle(4.0)
    assert waist.angle(3.5) == pytest.approx(0.2 + 25 * TICK, abs=TICK)
    assert waist.angle(2.5) == pytest.approx(0.2)


# --- requested faults


@pytest.mark.parametrize(("make", "kind"), [(make, kind) for make in MAKES for kind in MAKES[make][2].names])
def test_each_kind_can_be_asked_for(make, kind) -> None:
    kinds = MAKES[make][2]
    text = f"{kind}@elbow" if kind in kinds.of_one_joint else kind
    assert FaultSpec.parsed(text, JOINTS, kinds).kind == kind


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
def test_invalid_fault_error_names_the_problem(text, said) -> None:
    with pytest.raises(ConfigError) as caught:
        FaultSpec.parsed(text, JOINTS, KINDS)
    assert f"--fault {text}: " in str(caught.value)
    assert said in str(caught.value)


def test_joint_fault_strikes_all_and_only_its_answers() -> None:
    faults = WireFaults([(5, 1.0, KINDS.on_the_wire["mute"])], Random(1))
    assert [bool(faults(Reply(id, 0.0, b"12")).data) for id in (5, 1, 5, 2)] == [False, True, False, True]


def test_fault_share_sets_the_rate_of_struck_answers() -> None:
    faults = WireFaults([(None, 0.1, KINDS.on_the_wire["mute"])], Random(1))
    struck = sum(not faults(Reply(1, 0.0, b"12")).data for _ in range(5000))
    assert 0.08 < struck / 5000 < 0.12


# --- motion


def test_path_is_played_to_its_end_and_back() -> None:
    (joint,) = played(np.array([[0.0], [1.0], [3.0]]), rate_hz=10.0, begin_s=5.0)
    assert [joint(5.0 + t) for t in (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)] == pytest.approx([0, 0.5, 1, 3, 1, 0, 1])


def test_a_swing_stays_within_the_limits() -> None:
    limits = [(-0.2, 1.0), (0.0, 0.1), (-math.inf, math.inf)]
    for joint, (lower, upper) in zip(swinging(limits, 0.0), limits, strict=True):
        angles = [joint(t) for t in np.linspace(0, 100, 1000)]
        assert lower < min(angles) < max(angles) < upper


# --- in the simulation's place


class Scripted:
    """A source of prepared readings."""

    joints = JOINTS

    def __init__(self, poses) -> None:
        self._readings = [JointReading(k / 10, np.array(pose)) for k, pose in enumerate(poses)]

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        pass

    def read(self, timeout_s: float) -> JointReading | None:
        return self._readings.pop(0) if self._readings else None


def through(source: Any, make: str) -> ThroughDriver:
    arm_of, config, _, driver = MAKES[make]

    @contextmanager
    def opened(angles: Any) -> Iterator[Behind]:
        arm = arm_of(config, angles)
        with (
            TemporaryDirectory() as folder,
            DryRun(arm, {name: Path(folder) / name for name in arm.devices}) as emulator,
            driver(emulator.config, JOINTS, SystemClock(), limits=LIMITS) as joints,
        ):
            yield Behind(joints, lambda: joints.read(1.0))

    return ThroughDriver(source, opened)


@SERVOS
def test_servo_readings_keep_times_and_have_servo_resolution(make) -> None:
    poses = [(0.5 + 1e-3 * k, 0.1, -0.2 - 2e-3 * k) for k in range(20)]
    with through(Scripted(poses), make) as source:
        seen = [source.read(1.0) for _ in poses]
        assert source.read(1.0) is None
    assert [told.t for told in seen if told] == [k / 10 for k in range(20)]
    q = np.array([told.q for told in seen if told])
    assert np.abs(q - poses).max() <= TICK / 2 + 1e-12
    assert q / TICK == pytest.approx(np.round(q / TICK), abs=1e-9)


@EACH
@pytest.mark.usefixtures("patient_host")
def test_readings_through_emulator_can_be_opened_again(make) -> None:
    source = through(Scripted([POSE] * 2), make)
    for _ in range(2):
        with source:
            told = source.read(1.0)
            assert told is not None
            assert told.q == pytest.approx(POSE, abs=TICK)
