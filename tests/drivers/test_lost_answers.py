"""Cost of lost and late answers; a late answer is never taken for the answer to a later request."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from itertools import pairwise
from random import Random
from statistics import median

import pytest
from emulated_arm import Arm
from feetech_arm import FeetechArm
from hypothesis import given
from hypothesis import strategies as st
from virtual_port import VirtualClock, VirtualPort
from wire_faults import Planned, Storm

from bodyschema.drivers.dynamixel.bus import Bus
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.emulator.device import Reply
from bodyschema.drivers.emulator.faults import mute
from bodyschema.drivers.feetech.emulator.arm import Chain as FeetechChain
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.drivers.feetech.joints import Bus as FeetechBus
from bodyschema.drivers.feetech.models import BY_NAME as FEETECH_MODELS

SYNC_READ, FAST_SYNC_READ = 0x82, 0x8A
MAKES = {
    "feetech": lambda **given: FeetechArm(("STS3215",) * 6, **given),
    "feetech one by one": lambda **given: FeetechArm(("STS3215",) * 6, sync="never", **given),
    "SCS": lambda **given: FeetechArm(("SCS0009",) * 6, **given),
    "sync read": lambda **given: Arm(fast="never", **given),
    "fast sync read": Arm,
    "protocol 1": lambda **given: Arm(("MX-28", "AX-12A", "MX-28"), **given),
}
BUSES = {
    "STS3215": (FeetechBus, FeetechChain, FeetechServo, FEETECH_MODELS),
    "SCS0009": (FeetechBus, FeetechChain, FeetechServo, FEETECH_MODELS),
    "XM430-W350": (Bus, Chain, Servo, BY_NAME),
    "AX-12A": (Bus, Chain, Servo, BY_NAME),
}


class LosesAnswersTo:
    """The wire of a chain that loses a given number of answers to one instruction."""

    def __init__(self, arm, code: int, times: float) -> None:
        self._arm, self._code, self.left = arm, code, times

    def __call__(self, reply: Reply) -> Reply:
        if self._arm.port.heard[-1].code != self._code or self.left <= 0:
            return reply
        self.left -= 1
        return replace(reply, data=b"")


@pytest.mark.parametrize(
    ("make", "code"), [(FeetechArm, SYNC_READ), (Arm, FAST_SYNC_READ)], ids=["feetech", "dynamixel"]
)
def test_one_lost_answer_at_opening_keeps_sync_read(make, code) -> None:
    arm = make()
    arm.chain.faults = LosesAnswersTo(arm, code, 1)
    with arm.joints:
        arm.port.heard.clear()
        arm.joints.read(0.1)
        assert code in {instruction.code for instruction in arm.port.heard}
    assert arm.joints.health == ()


def test_one_by_one_fallback_is_reported_and_ends() -> None:
    arm = FeetechArm()
    arm.chain.faults = lost = LosesAnswersTo(arm, SYNC_READ, math.inf)
    with arm.joints:
        arm.joints.read(0.1)
        assert arm.joints.bus_health["arm"].way == "one by one"
        assert arm.joints.health[0].startswith("bus arm: Sync Read was not answered by all its servos")
        lost.left = 0
        arm.clock.wait_until(arm.clock.now() + 10.0)
        arm.joints.read(0.1)
        assert arm.joints.bus_health["arm"].way == "Sync Read"
        assert arm.joints.health == ()


@pytest.mark.parametrize("make", MAKES.values(), ids=MAKES)
@pytest.mark.parametrize("missing", ["first", "last"])
def test_a_lost_answer_costs_one_reading(make, missing) -> None:
    arm = make(latency_s=2e-3)
    with arm.joints:
        for _ in range(20):
            arm.joints.read(0.1)
        readings = [arm.joints.read(0.1)]
        arm.faults.add(1 if missing == "first" else len(arm.names), mute, 1)
        readings += [arm.joints.read(0.1) for _ in range(3)]
        gaps = [after.t - before.t for before, after in pairwise(readings)]
    assert max(gaps) < 2 * median(gaps) + 8e-3


def rig(model: str, angles: list[float]):
    """Return a bus with one servo, whose shaft is at the next angle at each request."""
    bus_of, chain_of, servo_of, models = BUSES[model]
    clock, faults = VirtualClock(), Planned()
    chain = chain_of([servo_of(models[model], 1, lambda t: angles[0], return_delay_s=0.0)], faults)
    return bus_of("arm", VirtualPort(chain, clock), clock, 0.0), clock, faults, models[model]


def late_by(seconds: float):
    return lambda reply, rng: replace(reply, start=reply.start + seconds)


@pytest.mark.parametrize("model", BUSES)
@given(late_s=st.floats(3e-3, 0.05), pause_s=st.sampled_from([0.0, 1e-3]))
def test_late_answer_never_answers_the_next_request(model, late_s, pause_s) -> None:
    angles = [0.5]
    bus, clock, faults, servo = rig(model, angles)
    ask = bus.read_request(servo, 1, servo.layout["position"])
    old = bus.ask(ask).answers[0].status.data
    faults.add(1, late_by(late_s), 1)
    if bus.ask(ask).trouble is None:
        return  # it was not late enough
    angles[0] = -0.5
    faults.add(1, mute, 8)
    bus.listen(clock.now() + pause_s)
    for _ in range(20):
        assert all(answer.status.data != old for answer in bus.ask(ask).answers)
    assert bus.ask(ask).trouble is None


@pytest.mark.parametrize("model", BUSES)
def test_late_answer_does_not_delay_the_next_request(model) -> None:
    bus, clock, faults, servo = rig(model, [0.5])
    ask = bus.read_request(servo, 1, servo.layout["position"])
    faults.add(1, late_by(6e-3), 1)
    assert bus.ask(ask).trouble is not None
    begin = clock.now()
    assert bus.ask(ask).trouble is None
    assert clock.now() - begin < 4e-3


class RepeatsItself:
    """The wire of a chain on which some answers repeat the data of an earlier answer of the same length."""

    def __init__(self, before: int, share: float) -> None:
        self._told: dict[tuple[int, int], deque[bytes]] = {}
        self._before, self._share, self._rng = before, share, Random(1)

    def __call__(self, reply: Reply) -> Reply:
        told = self._told.setdefault((reply.id, len(reply.data)), deque(maxlen=self._before))
        repeated = told[0] if len(told) == self._before and self._rng.random() < self._share else None
        told.append(reply.data)
        return reply if repeated is None else replace(reply, data=repeated)


@pytest.mark.parametrize(
    "make", [MAKES["feetech"], MAKES["SCS"], MAKES["protocol 1"]], ids=["STS", "SCS", "protocol 1"]
)
def test_repeated_earlier_answer_is_rarely_accepted(make) -> None:
    arm = make()
    wrong = 0
    with arm.joints:
        arm.chain.faults = RepeatsItself(8, 0.01)
        for _ in range(500):
            reading = arm.joints.read(0.1)
            wrong += reading is not None and arm.error(reading) > 0.01
    assert wrong <= 1


@pytest.mark.parametrize("loss", [0.02, 0.05])
def test_lost_answers_cost_only_the_readings_struck(loss) -> None:
    arm = FeetechArm(("STS3215",) * 6)
    arm.chain.faults = Storm({"mute": (loss, mute)}, Random(3))
    with arm.joints:
        begin, count = arm.clock.now(), 0
        while arm.clock.now() < begin + 1.5:
            count += arm.joints.read(0.1) is not None
    assert count / 1.5 > 0.93 * (1 - loss) ** 6 * 249
