"""Port scans: servos found at any baud rate, in any protocol."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest
from virtual_port import VirtualClock, VirtualPort

from bodyschema.daemon.wiring.servos import SCANNERS
from bodyschema.drivers.dynamixel.bus import LIKELY_FIRST
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.frames import Code, Error, instructions_in
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.emulator.device import AnswerOnlyDevice, Faults, Reply, no_faults
from bodyschema.drivers.emulator.pty_shell import PtyShell
from bodyschema.drivers.feetech.emulator.arm import Chain as FeetechChain
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.drivers.feetech.joints import FeetechPackets
from bodyschema.drivers.feetech.models import BAUDS as FEETECH_BAUDS
from bodyschema.drivers.feetech.models import BY_NAME as FEETECH
from bodyschema.drivers.serial_line import serial_ports
from bodyschema.drivers.servos.scan import scan_port
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.servos import FoundServo, ScannedBus


def servo(model: str, id: int, baud: int = 1_000_000, **more) -> Servo:
    return Servo(BY_NAME[model], id, lambda _: 0.01 * id, baud=baud, booted_s=more.pop("booted_s", 0.1 * id), **more)


def feetech(model: str, id: int, baud: int = 1_000_000, rad: float = 0.1) -> FeetechServo:
    return FeetechServo(FEETECH[model], id, lambda _: rad, baud=baud)


class Cable(AnswerOnlyDevice):
    """Servos of both makes on one wire."""

    def __init__(self, servos: Sequence[Servo | FeetechServo], faults: Faults) -> None:
        self._chains = (
            Chain((servo for servo in servos if isinstance(servo, Servo)), faults),
            FeetechChain(servo for servo in servos if isinstance(servo, FeetechServo)),
        )

    def send(self, data: bytes, t: float, baud: int) -> list[Reply]:
        return [reply for chain in self._chains for reply in chain.send(data, t, baud)]


class Emulator:
    """Servos in virtual time."""

    def __init__(self, servos: Sequence[Servo | FeetechServo], faults: Faults = no_faults) -> None:
        self.chain, self.clock = Cable(servos, faults), VirtualClock()
        self.said: list[str] = []
        self.sent = bytearray()

    def open(self, _port: str, baud: int, _clock: object) -> VirtualPort:
        emulator = self

        class Listened(VirtualPort):
            def write(self, data: bytes) -> None:
                emulator.sent += data
                super().write(data)

        return Listened(self.chain, self.clock, baud)

    def scan(self, *bauds: int) -> ScannedBus:
        return scan_port("bus", SCANNERS, self.clock, self.said.append, bauds=bauds, open_port=self.open)


def found(*servos: Servo | FeetechServo, bauds: Sequence[int] = (1_000_000,)) -> tuple[FoundServo, ...]:
    return Emulator(servos).scan(*bauds).servos


def test_both_protocols_are_found_on_one_bus() -> None:
    told = found(servo("XM430-W350", 1), servo("MX-28", 4), servo("XL330-M288", 200))
    assert [(s.id, s.model, s.protocol) for s in told] == [
        (1, "XM430-W350", "Dynamixel 2.0"), (200, "XL330-M288", "Dynamixel 2.0"), (4, "MX-28", "Dynamixel 1.0"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("model", "baud"),
    [("XM430-W350", baud) for baud in LIKELY_FIRST]
    + [pytest.param("PH42-020-S300", baud, marks=pytest.mark.soak) for baud in LIKELY_FIRST]
    + [pytest.param("AX-12A", baud, marks=pytest.mark.soak) for baud in LIKELY_FIRST if baud <= 2_000_000],
)
def test_a_servo_is_found_at_every_rate(model, baud) -> None:
    told = found(servo(model, 7, baud), servo(model, 8, baud), bauds=())
    assert [(s.id, s.baud, s.model) for s in told] == [(7, baud, model), (8, baud, model)]


@pytest.mark.parametrize(
    ("model", "baud"),
    [
        # Each model and each rate once; every model at every rate in soak.
        pytest.param(model, baud, marks=() if k == j % len(FEETECH) else pytest.mark.soak)
        for k, model in enumerate(FEETECH)
        for j, baud in enumerate(FEETECH_BAUDS)
    ],
)
def test_a_feetech_servo_is_found_at_every_rate(model, baud) -> None:
    told = found(feetech(model, 9, baud), feetech(model, 10, baud), bauds=())  # 9 is a byte of an STS3215's number, too
    assert [(s.id, s.baud, s.model, s.protocol) for s in told] == [(id, baud, model, "Feetech") for id in (9, 10)]


def test_both_makes_are_told_apart_on_one_bus() -> None:
    told = found(feetech("STS3215", 3), servo("MX-28", 4), feetech("SCS0009", 5), servo("AX-12A", 9))
    assert [(s.id, s.model, s.protocol) for s in told] == [
        (3, "STS3215", "Feetech"), (4, "MX-28", "Dynamixel 1.0"), (5, "SCS0009", "Feetech"),
        (9, "AX-12A", "Dynamixel 1.0"),
    ]  # fmt: skip


@pytest.mark.parametrize("number", [1, 12, 300, 65535])
def test_unknown_feetech_model_is_reported_by_number(number) -> None:
    strange = feetech("STS3215", 3)
    strange["model"] = number
    (told,) = found(strange, bauds=[1_000_000])
    assert (told.protocol, told.model, told.troubles) == (
        "Feetech", f"model {number}", ("a model that no driver knows",),
    )  # fmt: skip


def test_duplicate_feetech_id_is_reported() -> None:
    told = found(feetech("STS3215", 3, rad=0.3), feetech("STS3215", 3, rad=0.7), feetech("STS3215", 5))
    assert [(s.id, s.is_double) for s in told] == [(3, True), (5, False)]


def test_feetech_scan_reports_firmware_state_and_troubles() -> None:
    holding = feetech("STS3215", 3)
    holding["torque"] = 1
    holding.fail(0x04)
    (told,) = found(holding, bauds=[1_000_000])
    assert (told.firmware, told.voltage_v, told.temperature_c, told.has_torque) == (
        "3.10",
        pytest.approx(7.4),
        31.0,
        False,
    )
    assert told.troubles == ("it is too hot: let it cool down",)


def test_unsupported_rate_is_reported_as_trouble() -> None:
    (told,) = found(servo("MX-28", 3, 500_000), bauds=())
    assert told.troubles == ("robot.toml has no such rate: give it 1,000,000 bit/s",)


def test_scan_reports_firmware_state_and_voltage() -> None:
    (told,) = found(servo("XM430-W350", 3))
    assert (told.firmware, told.temperature_c, told.has_torque, told.troubles) == ("46", 31.0, False, ())
    assert told.voltage_v == pytest.approx(12.0)


@pytest.mark.parametrize("model", ["XM430-W350", "MX-28"])
def test_overloaded_servo_is_reported_with_its_remedy(model) -> None:
    sick = servo(model, 3)
    sick.fail(0x20)
    assert "it is overloaded: free the joint" in found(sick)[0].troubles[0]


@pytest.mark.parametrize("model", ["XM430-W350", "MX-28"])
def test_active_torque_is_reported_and_left_on(model) -> None:
    holding = servo(model, 3)
    holding["torque"] = 1
    assert found(holding)[0].has_torque is True
    assert holding["torque"] == 1


def test_duplicate_id_of_one_model_is_reported() -> None:
    twins = [Servo(BY_NAME["XM430-W350"], 3, lambda _, q=q: q, booted_s=q) for q in (0.3, 0.7)]
    (told,) = found(*twins)
    assert told.is_double
    assert "two servos have this ID" in told.troubles[0]


@pytest.mark.parametrize(("one", "other"), [("XM430-W350", "XL330-M288"), ("MX-28", "AX-12A")])
def test_duplicate_id_of_two_models_is_reported(one, other) -> None:
    told = found(servo(one, 3), servo(other, 3), servo(one, 5))
    assert [(s.id, s.is_double) for s in told] == [(3, True), (5, False)]


def test_servo_answering_no_read_names_its_register() -> None:
    silent = servo("XM430-W350", 3)
    silent["status_return"] = 0
    assert "Status Return Level (68" in found(silent)[0].troubles[0]


def test_servo_answering_no_read_names_both_possible_makes() -> None:
    silent = servo("MX-28", 3)
    silent["status_return"] = 0
    dynamixel_1, of_feetech = found(silent)[0].troubles
    assert dynamixel_1.startswith("if Dynamixel 1.0: answers PING but no READ: its Status Return Level (16")
    assert of_feetech == f"if Feetech: {FeetechPackets.pinged_only}"


def test_feetech_servo_answering_no_read_has_no_trouble() -> None:
    assert "Status Return" not in FeetechPackets.pinged_only
    level_0 = feetech("STS3215", 3)
    level_0["status_return"] = 0
    assert found(level_0)[0].troubles == ()


class XL320(Servo):
    """A servo whose control table begins as an XL-320's does: number, firmware, ID, baud rate, return delay."""

    def read(self, address: int, size: int, t: float) -> tuple[Error, bytes]:
        table = (350).to_bytes(2, "little") + bytes((29, self.id, 3, 250, 0, 0, 0xFF, 0x03)) + bytes(43)
        return (Error.NONE, table[address : address + size]) if address + size <= len(table) else (Error.ACCESS, b"")


def test_xl_320_is_named_as_without_driver() -> None:
    told = found(XL320(BY_NAME["XL330-M288"], 5, lambda _: 0.0), servo("XL330-M288", 6), bauds=[1_000_000])
    assert [(s.id, s.model) for s in told] == [(5, "XL-320"), (6, "XL330-M288")]
    assert told[0].troubles[0].startswith("no driver reads an XL-320")


def test_scan_writes_to_no_servo() -> None:
    emulator = Emulator([servo("XM430-W350", 1), servo("MX-28", 4), feetech("STS3215", 5)])
    emulator.scan()
    told = instructions_in(emulator.sent)[0]
    assert {instruction.code for instruction in told} == {Code.PING, Code.READ}


def test_all_rates_take_less_than_15_s() -> None:
    emulator = Emulator(
        [servo("XM430-W350", id) for id in range(1, 7)] + [feetech("STS3215", id) for id in range(11, 17)]
    )
    begin = emulator.clock.now()
    emulator.scan()
    assert emulator.clock.now() - begin < 15.0


def test_progress_is_reported_for_each_rate() -> None:
    emulator = Emulator([servo("XM430-W350", 1)])
    emulator.scan(1_000_000, 57_600)
    assert emulator.said[-1] == "bus: Dynamixel 1.0 and Feetech at 57,600 bit/s; 1 servo so far"
    assert len(emulator.said) == 4


def test_lost_port_keeps_the_servos_found() -> None:
    emulator = Emulator([servo("XM430-W350", 1)])

    def opened(port, baud, clock):
        if baud != 1_000_000:
            raise SourceError("bus is gone")
        return emulator.open(port, baud, clock)

    told = scan_port("bus", SCANNERS, emulator.clock, emulator.said.append, open_port=opened)
    assert ([s.id for s in told.servos], told.trouble) == ([1], "bus is gone")


@pytest.mark.usefixtures("patient_host")
def test_scan_of_a_pseudo_terminal_finds_its_servos(tmp_path: Path) -> None:
    there = [(1, "XM430-W350"), (2, "MX-28")]
    servos = [servo("XM430-W350", 1, booted_s=0.0), servo("MX-28", 2)]
    port = str(tmp_path / "bus")
    with PtyShell(Chain(servos), tmp_path / "bus"):
        told = scan_port(port, SCANNERS, SystemClock(), lambda _: None, bauds=[1_000_000])
    assert [(s.id, s.model) for s in told.servos] == there


def test_ports_get_their_stable_names(tmp_path: Path) -> None:
    for name in ("ttyUSB0", "ttyACM3", "ttyS0"):
        (tmp_path / "dev").mkdir(exist_ok=True)
        (tmp_path / "dev" / name).touch()
    by_id = tmp_path / "dev" / "serial" / "by-id"
    by_id.mkdir(parents=True)
    (by_id / "usb-FTDI-if00").symlink_to("../../ttyUSB0")
    assert serial_ports(tmp_path) == [str(by_id / "usb-FTDI-if00"), str(tmp_path / "dev" / "ttyACM3")]


def test_a_machine_without_adapters_has_no_ports(tmp_path: Path) -> None:
    assert serial_ports(tmp_path) == []


@pytest.mark.parametrize("lost", [1, 2, 3, 4])
def test_servo_is_found_despite_one_lost_answer(lost) -> None:
    answers = count(1)

    def lose(reply: Reply) -> Reply:
        return replace(reply, data=b"") if next(answers) == lost else reply

    emulator = Emulator([servo("XM430-W350", id) for id in (1, 2, 3, 4)], lose)
    assert [found.id for found in emulator.scan(1_000_000).servos] == [1, 2, 3, 4]
