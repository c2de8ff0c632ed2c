"""Buses with faults beyond lost answers: adapters that echo, duplicate answers, endless bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any

import pytest
from emulated_arm import Arm
from feetech_arm import FeetechArm
from servo_arm import TICK
from virtual_port import VirtualClock, VirtualPort

from bodyschema.daemon.wiring.servos import SCANNERS
from bodyschema.drivers.dynamixel.bus import Bus
from bodyschema.drivers.dynamixel.emulator.arm import swapped
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.joints import DYNAMIXEL
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.emulator.device import AnswerOnlyDevice, Device, Reply
from bodyschema.drivers.feetech.emulator.arm import Chain as FeetechChain
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.drivers.feetech.joints import Bus as FeetechBus
from bodyschema.drivers.feetech.models import BY_NAME as FEETECH_MODELS
from bodyschema.drivers.servos.eeprom_editor import EepromEditor
from bodyschema.drivers.servos.scan import scan_port
from bodyschema.interfaces.errors import SourceLost

Change = Callable[[bytes, list[Reply], float], list[Reply]]
MAKES: dict[str, Callable[[], Any]] = {
    "fast sync read": Arm,
    "sync read": lambda: Arm(fast="never"),
    "protocol 1": lambda: Arm(("MX-28", "AX-12A", "MX-28")),
    "feetech": FeetechArm,
    "feetech one by one": lambda: FeetechArm(sync="never"),
    "SCS": lambda: FeetechArm(("SCS0009",) * 3),
}
WEAK = {
    "STS3215": (FeetechBus, FeetechChain, FeetechServo, FEETECH_MODELS),
    "SCS0009": (FeetechBus, FeetechChain, FeetechServo, FEETECH_MODELS),
    "MX-28": (Bus, Chain, Servo, BY_NAME),
}


class Wire(AnswerOnlyDevice):
    """A device whose answers are changed on the wire."""

    def __init__(self, device: Device, change: Change) -> None:
        self._device, self._change = device, change

    def send(self, data: bytes, t: float, baud: int) -> list[Reply]:
        return self._change(data, self._device.send(data, t, baud), t)


def echo(data: bytes, replies: list[Reply], t: float) -> list[Reply]:
    """Prepend the sent bytes to the replies, like an adapter that echoes."""
    return [Reply(0, t, data), *replies]


@pytest.mark.parametrize("make", MAKES.values(), ids=MAKES)
def test_echoing_adapter_gives_correct_readings(make) -> None:
    arm = make()
    arm.port.device = Wire(arm.chain, echo)
    with arm.joints:
        readings = [arm.joints.read(0.1) for _ in range(100)]
        assert max(arm.error(reading) for reading in readings) < 0.5 * TICK + 3e-3
    assert arm.joints.dropped == 0


def test_a_scan_through_an_echo_finds_the_servos() -> None:
    clock = VirtualClock()
    chain = Chain([Servo(BY_NAME["XM430-W350"], 1, lambda _: 0.0), Servo(BY_NAME["MX-28"], 4, lambda _: 0.0)])

    def open_port(_port: str, baud: int, _clock: object) -> VirtualPort:
        return VirtualPort(Wire(chain, echo), clock, baud)

    told = scan_port("bus", SCANNERS, clock, lambda _: None, open_port=open_port).servos
    assert [(servo.id, servo.model, servo.troubles) for servo in told] == [(1, "XM430-W350", ()), (4, "MX-28", ())]


def test_echo_is_not_taken_for_a_servo() -> None:
    clock, chain = VirtualClock(), Chain([Servo(BY_NAME["MX-28"], 1, lambda _: 0.0)])
    with EepromEditor(DYNAMIXEL, clock, lambda _, baud: (VirtualPort(Wire(chain, echo), clock, baud), 0.0)) as emulator:
        bus = emulator.bus("emulator", 1_000_000)
        assert [emulator.is_taken(bus, id) for id in (1, 2)] == [True, False]


@pytest.mark.parametrize("make", MAKES.values(), ids=MAKES)
def test_answers_of_other_servos_at_opening_raise_loss(make) -> None:
    arm = make()

    def of_another(_data: bytes, replies: list[Reply], _t: float) -> list[Reply]:
        return [swapped(reply, Random(3)) for reply in replies]

    arm.port.device = Wire(arm.chain, of_another)
    with pytest.raises(SourceLost, match="another servo's answer"):
        arm.joints.__enter__()


@pytest.mark.parametrize("model", WEAK)
@pytest.mark.parametrize("later", [1, 2, 3, 4])
def test_repeated_answer_never_answers_a_later_request(model, later) -> None:
    bus_of, chain_of, servo_of, models = WEAK[model]
    clock, angles = VirtualClock(), [0.5]
    chain = chain_of([servo_of(models[model], 1, lambda _: angles[0], return_delay_s=500e-6)])

    def twice(_data: bytes, replies: list[Reply], _t: float) -> list[Reply]:
        return [*replies, *(replace(reply, start=reply.start + later * 5e-3) for reply in replies)]

    bus = bus_of("arm", VirtualPort(Wire(chain, twice), clock), clock, 0.0)
    ask = bus.read_request(models[model], 1, models[model].layout["position"])
    old = bus.ask(ask).answers[0].status.data
    angles[0] = -0.5
    for k in range(1, later + 1):
        clock.wait_until(100.0 + k * 5e-3 + 0.3e-3)
        assert all(answer.status.data != old for answer in bus.ask(ask).answers)


class Babble:
    """A port at which there is always something to receive."""

    baud = 1_000_000

    def __init__(self, clock: VirtualClock) -> None:
        self._clock, self.received = clock, 0

    def write(self, data: bytes) -> None:
        """Ignore the data."""

    def receive(self, until: float) -> bytes:
        self._clock.wait_until(self._clock.now() + 1e-4)
        self.received += 1
        assert self.received < 10_000, "no end"
        return b"\x55"

    def flush(self) -> None:
        """Do nothing: more data come."""

    def close(self) -> None:
        """Do nothing: more data come."""


@pytest.mark.parametrize("model", WEAK)
def test_noise_without_end_does_not_hold_the_driver(model) -> None:
    clock, (bus_of, _, _, models) = VirtualClock(), WEAK[model]
    bus = bus_of("arm", Babble(clock), clock, 0.0)
    assert bus.ask(bus.read_request(models[model], 1, models[model].layout["position"])).trouble is not None
    assert not bus.listen(clock.now() + 5e-3)


def once(arm: Any, place: int, value: int) -> Change:
    """Change one byte in the first answer to a torque query, with a valid checksum."""
    state, left = arm.chain.servo(1).model.layout.state, [1]

    def change(data: bytes, replies: list[Reply], _t: float) -> list[Reply]:
        if not left or data[4:6] != bytes((2, state.address)) or not replies:
            return replies
        left.clear()
        wrong = bytearray(replies[0].data)
        wrong[place] = value
        wrong[-1] = ~sum(wrong[2:-1]) & 0xFF
        return [replace(replies[0], data=bytes(wrong))]

    return change


@pytest.mark.parametrize(
    "make", [MAKES["protocol 1"], MAKES["feetech"], MAKES["SCS"]], ids=["protocol 1", "STS", "SCS"]
)
@pytest.mark.parametrize(("place", "value"), [(4, 0x20), (5, 1)], ids=["alert", "torque"])
def test_single_answer_does_not_prove_alert_or_torque(make, place, value) -> None:
    arm = make()
    with arm.joints:
        arm.joints.read(0.1)
        arm.port.device = Wire(arm.chain, once(arm, place, value))
        for _ in range(100):
            arm.joints.read(0.1)
            assert arm.joints.health == ()


@pytest.mark.parametrize(
    "make", [MAKES["protocol 1"], MAKES["feetech"], MAKES["SCS"]], ids=["protocol 1", "STS", "SCS"]
)
def test_single_answer_does_not_prove_torque_off(make) -> None:
    arm = make()
    arm.chain.servo(1)["torque"] = 1
    arm.port.device = Wire(arm.chain, once(arm, 5, 0))
    with arm.joints:
        assert arm.chain.servo(1)["torque"] == 0
        assert arm.joints.servos[0].had_torque
