"""Writes to servo EEPROMs, on the emulator in virtual time."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files

import pytest
from virtual_port import VirtualClock, VirtualPort, at_once

from bodyschema.drivers.dynamixel.emulator.chain import Chain as DynamixelChain
from bodyschema.drivers.dynamixel.emulator.servo import Servo as DynamixelServo
from bodyschema.drivers.dynamixel.joints import DYNAMIXEL, settings_of
from bodyschema.drivers.dynamixel.models import BY_NAME as DYNAMIXELS
from bodyschema.drivers.dynamixel.models import MODELS
from bodyschema.drivers.emulator.device import Reply
from bodyschema.drivers.emulator.faults import mute
from bodyschema.drivers.feetech.emulator.arm import Chain as FeetechChain
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.drivers.feetech.joints import FEETECH
from bodyschema.drivers.feetech.models import BY_NAME as FEETECHS
from bodyschema.drivers.servos.config import ServoConfig
from bodyschema.drivers.servos.eeprom_editor import Change, EepromEditor, Outcome
from bodyschema.interfaces.errors import ConfigError, SourceError

RATE = 1_000_000
ARMS = [("XM430-W350", "XM430-W350"), ("MX-28", "MX-28"), ("STS3215", "STS3215"), ("SCS0009", "SCS0009")]


class Arm:
    """Two servos, IDs 1 and 2, and an EEPROM editor."""

    def __init__(self, models: tuple[str, ...] = ("XM430-W350", "XM430-W350"), angle: float = 0.3) -> None:
        self.clock = VirtualClock()
        is_dynamixel = models[0] in DYNAMIXELS
        known = DYNAMIXELS if is_dynamixel else FEETECHS
        self.models = [known[name] for name in models]
        kinds = (DynamixelChain, DynamixelServo) if is_dynamixel else (FeetechChain, FeetechServo)
        self.chain = kinds[0]([kinds[1](model, id, lambda _: angle) for id, model in enumerate(self.models, 1)])
        self.emulator = EepromEditor(DYNAMIXEL if is_dynamixel else FEETECH, self.clock, self.open)

    def open(self, port: str, baud: int):
        return VirtualPort(self.chain, self.clock, outwards=at_once, inwards=at_once, baud=baud), 0.0

    @property
    def bus(self):
        return self.emulator.bus("emulator", RATE)

    def identified_servo(self, id: int = 1):
        return self.emulator.identified_servo(
            self.bus, ServoConfig(f"joint{id}", id, self.models[id - 1].name), self.models[id - 1]
        )

    def change(self, name: str, target: int, id: int = 1) -> Change:
        servo = self.identified_servo(id)
        setting = {setting.name: setting for setting in self.emulator.vendor.settings(servo.model)}[name]
        return Change(servo, setting, self.emulator.value(self.bus, servo, setting), target)


@pytest.mark.parametrize("models", ARMS)
def test_a_number_is_written_and_read_back(models) -> None:
    arm = Arm(models)
    done = arm.emulator.write(arm.bus, arm.change("return_delay", 0))
    assert (done.outcome, done.found, done.remarks) == (Outcome.WRITTEN, 0, "")
    assert (arm.chain.servo(1)["return_delay"], arm.chain.servo(2)["return_delay"]) == (0, 250)


@pytest.mark.parametrize("models", ARMS)
def test_written_value_survives_a_power_cycle(models) -> None:
    arm = Arm(models)
    arm.emulator.write(arm.bus, arm.change("return_delay", 0))
    arm.chain.power_cycle(arm.clock.now())
    assert arm.chain.servo(1)["return_delay"] == 0


@pytest.mark.parametrize("models", ARMS[2:])
def test_the_eeprom_is_locked_again(models) -> None:
    arm = Arm(models)
    for name, target in (("return_delay", 0), ("id", 9)):
        assert arm.emulator.write(arm.bus, arm.change(name, target)).remarks == ""
    assert arm.chain.servo(9)["lock"] == 1


@pytest.mark.parametrize("models", ARMS)
def test_servo_answers_at_its_new_id(models) -> None:
    arm = Arm(models)
    assert arm.emulator.write(arm.bus, arm.change("id", 7)).outcome is Outcome.WRITTEN
    assert (arm.emulator.is_taken(arm.bus, 7), arm.emulator.is_taken(arm.bus, 1)) == (True, False)


@pytest.mark.parametrize("models", ARMS)
def test_all_servos_answer_at_the_new_rate(models) -> None:
    arm = Arm(models)
    changes = [arm.change("baud", 0, id) for id in (1, 2)]
    target = changes[0].setting.words["57600"]
    changes = [replace(change, target=target) for change in changes]
    done = arm.emulator.write_bauds("emulator", RATE, 57_600, changes)
    assert [one.outcome for one in done] == [Outcome.WRITTEN] * 2
    assert [servo.baud // 100 for servo in arm.chain.servos] in ([576, 576], [571, 571])


def test_servo_refusing_a_new_rate_keeps_the_old() -> None:
    arm = Arm()
    arm.chain.servo(1)["torque"] = 1
    change = arm.change("baud", 1)
    (done,) = arm.emulator.write_bauds("emulator", RATE, 57_600, [change])
    assert (done.outcome, done.remarks) == (Outcome.KEPT, "it still answers at 1,000,000 bit/s")


def test_refused_write_is_reported_as_kept() -> None:
    arm = Arm()
    arm.chain.servo(1)["torque"] = 1  # locks the EEPROM
    done = arm.emulator.write(arm.bus, arm.change("return_delay", 0))
    assert (done.outcome, done.found) == (Outcome.KEPT, 250)


@pytest.mark.parametrize("models", ARMS)
def test_lost_cable_after_write_gives_unknown_outcome(models) -> None:
    arm = Arm(models)
    change = arm.change("return_delay", 0)

    def cut(reply: Reply) -> Reply:
        return mute(reply, None) if arm.chain.servo(1)["return_delay"] == 0 else reply

    arm.chain.faults = cut
    done = arm.emulator.write(arm.bus, change)
    assert (done.outcome, done.found) == (Outcome.UNKNOWN, None)
    assert "no answer after it was written" in done.remarks


@pytest.mark.parametrize("models", ARMS)
def test_torque_is_off_before_anything_is_written(models) -> None:
    arm = Arm(models)
    arm.chain.servo(1)["torque"] = 1
    arm.emulator.torque_off(arm.bus, [arm.identified_servo()])
    assert arm.chain.servo(1)["torque"] == 0


@pytest.mark.parametrize("models", [ARMS[0], ARMS[2]])
@pytest.mark.parametrize("angle", [0.3, -0.9, 1.4])
def test_homing_offset_makes_the_current_position_zero(models, angle) -> None:
    arm = Arm(models, angle)
    servo = arm.identified_servo()
    arm.emulator.write(arm.bus, arm.change("homing_offset", arm.emulator.homing_offset(arm.bus, servo)))
    assert arm.emulator.position(arm.bus, servo) == servo.zero_ticks


def test_servo_of_another_model_is_not_written() -> None:
    arm = Arm()
    wrong = DYNAMIXELS["XM540-W270"]
    with pytest.raises(SourceError, match=r"XM430-W350: wrong model.*nothing was written"):
        arm.emulator.identified_servo(arm.bus, ServoConfig("joint1", 1, wrong.name), wrong)


@pytest.mark.parametrize("models", ARMS)
def test_unlisted_servo_reports_its_model(models) -> None:
    arm = Arm(models)
    assert arm.emulator.model_at(arm.bus, 2) == arm.models[1]


@pytest.mark.parametrize(
    ("text", "remarks"), [("255", "from 0 to 254"), ("-1", "from 0 to 254"), ("much", "from 0 to 254")]
)
def test_out_of_range_value_error_states_the_range(text, remarks) -> None:
    (delay,) = [setting for setting in settings_of(DYNAMIXELS["XM430-W350"]) if setting.name == "return_delay"]
    with pytest.raises(ConfigError, match=remarks):
        delay.value(text)


def test_model_without_current_sensor_lacks_current_mode() -> None:
    (mode,) = [setting for setting in settings_of(DYNAMIXELS["XL430-W250"]) if setting.name == "operating_mode"]
    with pytest.raises(ConfigError, match="there is no such value"):
        mode.value("0")


@pytest.mark.parametrize("model", [model for model in MODELS if model.protocol == 2], ids=lambda model: model.name)
def test_settings_match_the_sdk_control_tables(model) -> None:
    tables = files("dynamixel_easy_sdk") / "control_table"
    names = dict(line.split("\t")[:2] for line in (tables / "dynamixel.model").read_text().splitlines()[1:])
    rows = [line.split("\t") for line in (tables / names[str(model.number)].strip()).read_text().splitlines()]
    places = {(int(row[0]), int(row[1])): row[2] for row in rows if len(row) == 3 and row[0].isdigit()}
    for setting in settings_of(model):
        theirs = places[setting.register.address, setting.register.size].lower().replace(" ", "_")
        assert theirs.replace("(shadow)", "").replace("_rate", "").replace("_time", "") == setting.name


@pytest.mark.parametrize("make", [DYNAMIXEL, FEETECH], ids=lambda make: make.table)
def test_settings_lie_in_eeprom_without_overlap(make) -> None:
    for model in make.models.values():
        ends = 0
        for setting in make.settings(model):
            assert ends <= setting.register.address
            assert setting.register.bytes(setting.lowest) != setting.register.bytes(setting.highest)
            ends = setting.register.end
        assert ends <= model.layout.ram
