"""The emulators on a pseudo-terminal with the unmodified rustypot: a client that shares no code with the project."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bodyschema.drivers.dynamixel.emulator.chain import Chain as DynamixelChain
from bodyschema.drivers.dynamixel.emulator.servo import Servo as DynamixelServo
from bodyschema.drivers.dynamixel.models import BY_NAME as DYNAMIXEL
from bodyschema.drivers.emulator.pty_shell import PtyShell
from bodyschema.drivers.feetech.emulator.arm import Chain as FeetechChain
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.drivers.feetech.models import BY_NAME as FEETECH

rustypot = pytest.importorskip("rustypot")

IDS = (1, 2, 7)
ANGLES = (0.5, -1.0, 0.3)
# Timeouts of a real client: a busy machine may hold up the emulator that answers, and an absent servo costs all of it.
TIMEOUT_S, OF_ABSENT_S, OF_BOTH_S = 20.0, 0.1, 1.0
SCANS = 200  # rustypot waits some 5 ms for each servo, whatever its timeout, and a busy emulator answers later


def dynamixel(model: str) -> DynamixelChain:
    kind = DYNAMIXEL[model]
    told = zip(IDS, ANGLES, strict=True)
    return DynamixelChain(DynamixelServo(kind, id, lambda _, a=a: a, return_delay_s=0) for id, a in told)


def feetech(model: str) -> FeetechChain:
    kind = FEETECH[model]
    told = zip(IDS, ANGLES, strict=True)
    return FeetechChain(FeetechServo(kind, id, lambda _, a=a: a, return_delay_s=0) for id, a in told)


CHAINS: dict[str, Callable[[], Any]] = {
    "XL330-M288": lambda: dynamixel("XL330-M288"),
    "XL430-W250": lambda: dynamixel("XL430-W250"),
    "MX-28": lambda: dynamixel("MX-28"),
    "AX-12A": lambda: dynamixel("AX-12A"),
    "STS3215": lambda: feetech("STS3215"),
    "SCS0009": lambda: feetech("SCS0009"),
}
CONTROLLERS = {
    "XL330-M288": "Xl330PyController", "XL430-W250": "Xl430PyController", "MX-28": "MxPyController",
    "AX-12A": "AxPyController", "STS3215": "Sts3215PyController", "SCS0009": "Scs0009PyController",
}  # fmt: skip
MODELS = DYNAMIXEL | FEETECH
# Models that answer SYNC_READ by the manuals: neither Protocol 1.0 of Dynamixel nor the SCS series of Feetech.
TOGETHER = ["XL330-M288", "XL430-W250", "STS3215"]
EACH = pytest.mark.parametrize("model", CONTROLLERS)


class Emulator:
    """Servos of one model, and the client that is connected to them."""

    def __init__(self, model: str, folder: Path) -> None:
        self.model, self.chain = MODELS[model], CHAINS[model]()
        self.shell = PtyShell(self.chain, folder / "bus")
        self._controller = getattr(rustypot, CONTROLLERS[model])

    def __enter__(self) -> Emulator:
        self.shell.plug_in()
        self.connect(TIMEOUT_S)
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()
        self.shell.unplug()

    def connect(self, timeout_s: float) -> None:
        """Let a client with this timeout be the one that is connected."""
        self.client = self._controller(str(self.shell.link), 1_000_000, timeout_s)

    def ticks(self, id: int) -> int:
        """Return the servo's position in ticks."""
        return self.model.zero_ticks + round(ANGLES[IDS.index(id)] / self.model.rad_per_tick)


def scanned(scan: Callable[[], dict[int, int]], there: dict[int, int]) -> bool:
    """Scan until all servos present have answered in time; fail if any other answers."""
    for _ in range(SCANS):
        found = scan()
        assert found.items() <= there.items()
        if found == there:
            return True
    return False


@pytest.fixture
def emulator(model: str, tmp_path: Path) -> Iterator[Emulator]:
    with Emulator(model, tmp_path) as opened:
        yield opened


@EACH
def test_ping_finds_present_servos(emulator: Emulator) -> None:
    assert all(emulator.client.ping(id) for id in IDS)


@pytest.mark.parametrize("model", ["XL330-M288"])
def test_ping_finds_no_absent_servo(emulator: Emulator) -> None:
    emulator.client.close()
    emulator.connect(OF_ABSENT_S)
    assert not emulator.client.ping(9)


@EACH
def test_scan_reports_the_model_number(emulator: Emulator) -> None:
    assert scanned(lambda: emulator.client.scan([1, 3, 7]), {1: emulator.model.number, 7: emulator.model.number})


@EACH
def test_a_position_is_read(emulator: Emulator) -> None:
    assert [emulator.client.read_register(id, "present_position") for id in IDS] == [emulator.ticks(id) for id in IDS]


@EACH
def test_written_value_is_read_back(emulator: Emulator) -> None:
    emulator.client.write_register(2, "goal_position", 700)
    assert emulator.client.read_register(2, "goal_position") == 700
    assert emulator.chain.servo(2)["goal"] == 700


@EACH
def test_a_write_is_answered_without_an_error(emulator: Emulator) -> None:
    assert emulator.client.write_register_with_error(1, "torque_enable", 1) == 0
    assert emulator.chain.servo(1)["torque"] == 1


@EACH
def test_sync_write_writes_each_its_own(emulator: Emulator) -> None:
    emulator.client.sync_write_register([1, 7], "goal_position", [100, 900])
    assert emulator.client.read_register(7, "goal_position") == 900  # the line is silent after that
    assert [emulator.chain.servo(id)["goal"] for id in IDS] == [100, 0, 900]


@pytest.mark.parametrize("model", TOGETHER)
def test_sync_read_returns_positions_in_requested_order(emulator: Emulator) -> None:
    told = emulator.client.sync_read_register([7, 1, 2], "present_position")
    assert told == [emulator.ticks(7), emulator.ticks(1), emulator.ticks(2)]


@pytest.mark.parametrize("model", TOGETHER)
def test_sync_read_recovers_after_a_missing_servo(emulator: Emulator) -> None:
    emulator.client.close()
    emulator.connect(OF_BOTH_S)
    with pytest.raises(RuntimeError):
        emulator.client.sync_read_register([1, 9], "present_position")
    assert emulator.client.sync_read_register([1, 7], "present_position") == [emulator.ticks(1), emulator.ticks(7)]


@pytest.mark.parametrize("model", ["MX-28", "AX-12A", "SCS0009"])
def test_models_without_sync_read_stay_silent(emulator: Emulator) -> None:
    emulator.client.close()
    emulator.connect(OF_ABSENT_S)
    with pytest.raises(RuntimeError, match="timed out"):
        emulator.client.sync_read_raw_data([1, 2], 36, 2)


@pytest.mark.parametrize("model", ["XL330-M288", "XL430-W250"])
def test_fast_sync_read_gives_the_same(emulator: Emulator) -> None:
    emulator.client.set_fast_sync_read(True)
    assert emulator.client.sync_read_register(list(IDS), "present_position") == [emulator.ticks(id) for id in IDS]


@pytest.mark.parametrize("model", ["XL330-M288", "XL430-W250"])
def test_a_broadcast_ping_finds_all_of_protocol_2(emulator: Emulator) -> None:
    assert scanned(emulator.client.broadcast_scan, dict.fromkeys(IDS, emulator.model.number))


@pytest.mark.parametrize("model", ["STS3215"])
def test_broadcast_ping_finds_a_lone_feetech_servo(emulator: Emulator) -> None:
    del emulator.chain.servos[1:]  # "only applicable when there is only one servo on the bus": several answer at once
    assert scanned(emulator.client.broadcast_scan, {1: 777})


@pytest.mark.parametrize("model", ["XL330-M288", "XL430-W250"])
def test_reboot_is_answered_and_clears_torque_in_ram(emulator: Emulator) -> None:
    emulator.client.write_register(1, "torque_enable", 1)
    assert emulator.client.reboot(1)
    assert emulator.client.read_register(1, "torque_enable") == 0


@pytest.mark.parametrize("model", ["XL330-M288", "XL430-W250"])
def test_eeprom_is_locked_while_torque_is_on(emulator: Emulator) -> None:
    emulator.client.write_register(1, "torque_enable", 1)
    assert emulator.client.write_register_with_error(1, "return_delay_time", 3) == 7


@EACH
def test_id_change_is_answered_by_the_old_id(emulator: Emulator) -> None:
    definition = type(emulator.client).definition()
    emulator.client.close()
    with rustypot.Bus(str(emulator.shell.link), 1_000_000, TIMEOUT_S, {}) as opened:
        opened.change_id(definition, 2, 42)
    assert [servo.id for servo in emulator.chain.servos] == [1, 42, 7]


@pytest.mark.parametrize("model", [*TOGETHER, "SCS0009"])  # of the others rustypot knows no rates
def test_new_rate_applies_from_the_next_request(emulator: Emulator) -> None:
    definition = type(emulator.client).definition()
    emulator.client.close()
    with rustypot.Bus(str(emulator.shell.link), 1_000_000, TIMEOUT_S, {}) as opened:
        opened.change_baudrate(definition, 1, 57_600)
        assert scanned(lambda: opened.scan(definition, [1, 7]), {7: emulator.model.number})
        opened.set_baudrate(57_600)
        assert scanned(lambda: opened.scan(definition, [1, 7]), {1: emulator.model.number})


@pytest.mark.parametrize("model", ["STS3215"])
def test_id_in_locked_eeprom_reverts_on_power_cycle(emulator: Emulator) -> None:
    emulator.client.write_register(1, "id", 42)
    assert emulator.client.ping(42)
    emulator.chain.power_cycle(0.0)
    assert emulator.client.ping(1)


@pytest.mark.parametrize("model", ["XL330-M288", "MX-28", "STS3215"])
def test_servo_fault_sets_the_error_of_its_answers(emulator: Emulator) -> None:
    emulator.chain.servo(1).fail(0x20)
    _, error = emulator.client.read_register_with_error(1, "present_position")
    assert error == (0x80 if emulator.model.protocol == 2 else 0x20)


def test_mixed_models_and_protocols_share_a_bus(tmp_path: Path) -> None:
    there = {1: "XL330-M288", 2: "XL430-W250", 3: "MX-28"}
    chain = DynamixelChain(DynamixelServo(DYNAMIXEL[model], id, lambda _: 0.5) for id, model in there.items())
    definitions = {id: getattr(rustypot, CONTROLLERS[model]).definition() for id, model in there.items()}
    with (
        PtyShell(chain, tmp_path / "bus"),
        rustypot.Bus(str(tmp_path / "bus"), 1_000_000, TIMEOUT_S, definitions) as bus,
    ):
        expected = 2048 + round(0.5 / DYNAMIXEL["MX-28"].rad_per_tick)
        assert bus.sync_read_register([1, 2], "present_position") == [expected] * 2
        assert bus.read_register(3, "present_position") == expected
        assert bus.set_torque([1, 2, 3], True) == {}
    assert [servo["torque"] for servo in chain.servos] == [1, 1, 1]


@pytest.mark.parametrize("rate", [1_000_000, 57_600, 128_000])
def test_a_rate_without_a_name_is_known_too(rate, tmp_path: Path) -> None:
    chain = FeetechChain([FeetechServo(FEETECH["STS3215"], 1, lambda _: 0.0, baud=rate)])
    with PtyShell(chain, tmp_path / "bus"):
        client = rustypot.Sts3215PyController(str(tmp_path / "bus"), rate, TIMEOUT_S)
        assert client.ping(1)
        client.close()
