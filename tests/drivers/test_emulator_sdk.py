"""The emulator with the unmodified dynamixel-sdk, in virtual time; unplugging on a pseudo-terminal."""

from __future__ import annotations

import math
import termios

import dynamixel_sdk as sdk
import pytest
from virtual_port import VirtualClock, VirtualPort
from wire_faults import Planned

from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.emulator.faults import half, mute, wrong_checksum
from bodyschema.drivers.emulator.pty_shell import PtyShell

XM, AX, MX1, PH = BY_NAME["XM430-W350"], BY_NAME["AX-12A"], BY_NAME["MX-28"], BY_NAME["PH54-200-S500"]
ANGLES = {1: 0.5, 2: -1.0, 3: 7.0}
HEADER_LIKE = [0xFF, 0xFF, 0xFD, 0xFD]
P2, P1 = sdk.PacketHandler(2.0), sdk.PacketHandler(1.0)


def ticks(id: int) -> int:
    return round(ANGLES[id] * 4096 / (2 * math.pi)) + 2048


@pytest.fixture
def chain() -> Chain:
    turning = [Servo(XM, id, lambda t, a=angle: a if t > 0 else 0.0, return_delay_s=0) for id, angle in ANGLES.items()]
    old = [Servo(AX, 11, lambda t: 0.5, return_delay_s=0), Servo(MX1, 12, lambda t: -0.5, return_delay_s=0)]
    return Chain([*turning, *old, Servo(PH, 21, lambda t: 1.0, return_delay_s=0)], Planned())


class VirtualHandler(sdk.PortHandler):
    """The SDK's port connected to the emulator. Time passes while the SDK polls for bytes, which it does in a loop."""

    def __init__(self, chain: Chain) -> None:
        super().__init__("virtual")
        self._chain, self._clock, self._waiting = chain, VirtualClock(), bytearray()
        self.setBaudRate(self.baudrate)

    def setBaudRate(self, baudrate: int) -> bool:
        self.tx_time_per_byte = 10_000.0 / baudrate
        self._line = VirtualPort(self._chain, self._clock, baudrate)
        return True

    def clearPort(self) -> None:
        self._line.flush()
        self._waiting.clear()

    def writePort(self, packet: list[int]) -> int:
        self._line.write(bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> bytes:
        if len(self._waiting) < length:
            self._waiting += self._line.receive(self._clock.now() + 1e-3)
        data = bytes(self._waiting[:length])
        del self._waiting[:length]
        return data

    def getBytesAvailable(self) -> int:
        self._waiting += self._line.receive(self._clock.now() + 1e-3)
        return len(self._waiting)

    def getCurrentTime(self) -> float:
        return 1e3 * self._clock.now()


@pytest.fixture
def port(chain: Chain) -> sdk.PortHandler:
    return VirtualHandler(chain)


def signed(number: int) -> int:
    return number - 2**32 if number >= 2**31 else number


def test_ping_reports_the_model(port) -> None:
    assert P2.ping(port, 2) == (1020, sdk.COMM_SUCCESS, 0)
    assert P1.ping(port, 11) == (12, sdk.COMM_SUCCESS, 0)


def test_broadcast_ping_finds_all_of_the_protocol(port) -> None:
    found, result = P2.broadcastPing(port)
    assert result == sdk.COMM_SUCCESS
    assert found == {1: [1020, 46], 2: [1020, 46], 3: [1020, 46], 21: [2020, 46]}


def test_absent_id_does_not_answer(port) -> None:
    assert P2.ping(port, 9)[1] == sdk.COMM_RX_TIMEOUT


@pytest.mark.parametrize("id", ANGLES)
def test_the_position_is_read_with_its_turns(port, id) -> None:
    assert signed(P2.read4ByteTxRx(port, id, 132)[0]) == ticks(id)


def test_protocol_1_and_p_series_positions_are_read(port) -> None:
    assert P1.read2ByteTxRx(port, 11, 36)[0] == 512 + round(0.5 / (math.radians(300) / 1024))
    assert P1.read2ByteTxRx(port, 12, 36)[0] == 2048 - round(0.5 * 4096 / (2 * math.pi))
    assert P2.read4ByteTxRx(port, 21, 580)[0] == round(1003846 / (2 * math.pi))


def test_sync_read_gives_each_servo_s_position(port) -> None:
    group = sdk.GroupSyncRead(port, P2, 132, 4)
    for id in ANGLES:
        group.addParam(id)
    assert group.txRxPacket() == sdk.COMM_SUCCESS
    assert [signed(group.getData(id, 132, 4)) for id in ANGLES] == [ticks(1), ticks(2), ticks(3)]


def test_fast_sync_read_gives_the_same(port) -> None:
    group = sdk.GroupSyncRead(port, P2, 120, 16)
    for id in ANGLES:
        group.addParam(id)
    assert group.fastSyncRead() == sdk.COMM_SUCCESS
    assert [signed(group.getData(id, 132, 4)) for id in ANGLES] == [ticks(1), ticks(2), ticks(3)]


def test_bulk_read_reads_other_registers_of_each(port) -> None:
    group = sdk.GroupBulkRead(port, P2)
    group.addParam(1, 132, 4)
    group.addParam(2, 146, 1)
    assert group.txRxPacket() == sdk.COMM_SUCCESS
    assert (group.getData(1, 132, 4), group.getData(2, 146, 1)) == (ticks(1), 31)


def test_fast_bulk_read_reads_other_registers_of_each(port) -> None:
    group = sdk.GroupBulkRead(port, P2)
    group.addParam(1, 132, 4)
    group.addParam(2, 146, 1)
    group.addParam(3, 120, 16)
    assert group.fastBulkRead() == sdk.COMM_SUCCESS
    assert (group.getData(1, 132, 4), group.getData(2, 146, 1)) == (ticks(1), 31)
    assert signed(group.getData(3, 132, 4)) == ticks(3)


@pytest.mark.parametrize(
    ("id", "pointer", "data", "goal"), [(1, 168, 224, 116), (1, 632, 661, 116), (21, 168, 634, 564)]
)
def test_indirect_data_mirrors_the_addressed_register(port, chain, id, pointer, data, goal) -> None:
    assert P2.read2ByteTxRx(port, id, pointer)[0] == data
    assert P2.write2ByteTxRx(port, id, pointer, goal) == (sdk.COMM_SUCCESS, 0)
    assert P2.write1ByteTxRx(port, id, data, 7) == (sdk.COMM_SUCCESS, 0)
    assert chain.servo(id)["goal"] == 7
    assert P2.read1ByteTxRx(port, id, data) == (7, sdk.COMM_SUCCESS, 0)
    chain.servo(id).reboot(1.0)
    assert P2.read2ByteTxRx(port, id, pointer)[0] == data


def test_a_position_is_read_through_indirect_data(port) -> None:
    for k in range(4):
        P2.write2ByteTxRx(port, 3, 168 + 2 * k, 132 + k)
    assert signed(P2.read4ByteTxRx(port, 3, 224)[0]) == ticks(3)
    assert P2.write4ByteTxRx(port, 3, 224, 5) == (sdk.COMM_SUCCESS, 7)
    assert P2.write2ByteTxRx(port, 3, 168, 7)[1] != 0


def test_sync_write_writes_all(port, chain) -> None:
    group = sdk.GroupSyncWrite(port, P2, 64, 1)
    group.addParam(1, [1])
    group.addParam(3, [1])
    assert group.txPacket() == sdk.COMM_SUCCESS
    assert P2.read1ByteTxRx(port, 1, 64)[0] == 1
    assert [chain.servo(id)["torque"] for id in ANGLES] == [1, 0, 1]


def test_a_registered_write_waits_for_action(port, chain) -> None:
    assert P2.regWriteTxRx(port, 1, 116, 4, [0, 8, 0, 0]) == (sdk.COMM_SUCCESS, 0)
    assert chain.servo(1)["goal"] == 0
    P2.action(port, sdk.BROADCAST_ID)
    assert P2.read4ByteTxRx(port, 1, 116)[0] == 2048


def test_header_like_bytes_pass_through_the_stuffing(port, chain) -> None:
    chain.servo(1)["goal"] = int.from_bytes(bytes(HEADER_LIKE), "little", signed=True)
    assert P2.readTxRx(port, 1, 116, 4) == (HEADER_LIKE, sdk.COMM_SUCCESS, 0)


def test_eeprom_is_locked_while_torque_is_on(port) -> None:
    assert P2.write1ByteTxRx(port, 1, 9, 0) == (sdk.COMM_SUCCESS, 0)
    P2.write1ByteTxRx(port, 1, 64, 1)
    assert P2.write1ByteTxRx(port, 1, 9, 10) == (sdk.COMM_SUCCESS, 7)
    assert P2.read1ByteTxRx(port, 1, 9)[0] == 0


def test_measured_values_cannot_be_written(port) -> None:
    assert P2.write4ByteTxRx(port, 1, 132, 5) == (sdk.COMM_SUCCESS, 7)


def test_a_value_beyond_its_limit_is_refused(port) -> None:
    assert P2.write1ByteTxRx(port, 1, 64, 2) == (sdk.COMM_SUCCESS, 6)


def test_status_return_level_1_answers_reads_only(port) -> None:
    P2.write1ByteTxOnly(port, 1, 68, 1)
    assert P2.write1ByteTxRx(port, 1, 65, 1)[0] == sdk.COMM_RX_TIMEOUT
    assert P2.read1ByteTxRx(port, 1, 65) == (1, sdk.COMM_SUCCESS, 0)


def test_status_return_level_0_answers_ping_only(port) -> None:
    P2.write1ByteTxOnly(port, 1, 68, 0)
    assert P2.read1ByteTxRx(port, 1, 65)[1] == sdk.COMM_RX_TIMEOUT
    assert P2.ping(port, 1)[1] == sdk.COMM_SUCCESS


@pytest.mark.parametrize("bits", [0x01, 0x04, 0x08, 0x10, 0x20])
def test_hardware_error_sets_the_alert_until_reboot(port, chain, bits) -> None:
    chain.servo(1).fail(bits)
    value, result, error = P2.read1ByteTxRx(port, 1, 70)
    assert (value, result, error) == (bits, sdk.COMM_SUCCESS, 0x80)
    assert P2.reboot(port, 1)[0] == sdk.COMM_SUCCESS
    assert P2.read1ByteTxRx(port, 1, 70) == (0, sdk.COMM_SUCCESS, 0)


def test_overload_switches_torque_off(port, chain) -> None:
    P2.write1ByteTxRx(port, 1, 64, 1)
    chain.servo(1).fail(0x20)
    assert P2.read1ByteTxRx(port, 1, 64)[0] == 0


def test_a_power_cycle_loses_turns_and_torque(port, chain) -> None:
    chain.servo(3)["torque"] = 1
    chain.power_cycle(101.0)
    assert P2.read4ByteTxRx(port, 3, 132)[0] == ticks(3) % 4096
    assert P2.read1ByteTxRx(port, 3, 64)[0] == 0


def test_torque_on_in_position_mode_drops_whole_turns(port) -> None:
    before = P2.read4ByteTxRx(port, 3, 132)[0]
    P2.write1ByteTxRx(port, 3, 64, 1)
    assert before == ticks(3)
    assert P2.read4ByteTxRx(port, 3, 132)[0] == ticks(3) % 4096


def test_the_homing_offset_is_added(port) -> None:
    P2.write4ByteTxRx(port, 1, 20, 100)
    assert P2.read4ByteTxRx(port, 1, 132)[0] == ticks(1) + 100


@pytest.mark.parametrize(
    ("model", "address", "size", "number"),
    [
        ("XM430-W350", 31, 1, 80),
        ("XM430-W350", 38, 2, 1193),
        ("XM430-W350", 44, 4, 200),
        ("XM430-W350", 84, 2, 800),
        ("XM540-W270", 38, 2, 2047),
        ("XL330-M288", 34, 2, 35),
        ("XL330-M288", 76, 2, 1600),
        ("XL330-M288", 168, 2, 208),
        ("XL430-W250", 80, 2, 4000),
        ("MX-64(2.0)", 84, 2, 850),
        ("PH54-200-S500", 52, 4, 2**32 - 501_433),
        ("PH54-200-S500", 526, 2, 6153),
        ("MX-28", 8, 2, 4095),
        ("MX-28", 28, 1, 32),
        ("MX-28", 34, 2, 1023),
        ("AX-12A", 13, 1, 140),
        ("AX-12A", 28, 1, 32),
    ],
)
def test_limits_and_gains_match_a_new_servo(model, address, size, number) -> None:
    chain = Chain([Servo(BY_NAME[model], 1, lambda t: 0.0, return_delay_s=0)])
    chain.power_cycle(1.0)
    handler = P2 if BY_NAME[model].protocol == 2 else P1
    read = {1: handler.read1ByteTxRx, 2: handler.read2ByteTxRx, 4: handler.read4ByteTxRx}[size]
    assert read(VirtualHandler(chain), 1, address) == (number, sdk.COMM_SUCCESS, 0)


def test_factory_reset_except_id_keeps_the_id(port, chain) -> None:
    chain.servo(2)["return_delay"] = 3
    assert P2.factoryReset(port, 2, 0x02)[0] == sdk.COMM_SUCCESS
    assert P2.read1ByteTxRx(port, 2, 9)[0] == 250


def test_a_port_of_another_rate_hears_nothing(port) -> None:
    assert port.setBaudRate(57600)
    assert P2.ping(port, 1)[1] == sdk.COMM_RX_TIMEOUT
    assert port.setBaudRate(1_000_000)
    assert P2.ping(port, 1)[1] == sdk.COMM_SUCCESS


def test_two_servos_of_one_id_garble_each_other(port, chain) -> None:
    chain.servo(2)["id"] = 1
    assert P2.read4ByteTxRx(port, 1, 132)[1] == sdk.COMM_RX_CORRUPT


@pytest.mark.parametrize(
    ("fault", "result"),
    [(mute, sdk.COMM_RX_TIMEOUT), (wrong_checksum, sdk.COMM_RX_CORRUPT), (half, sdk.COMM_RX_CORRUPT)],
)
def test_a_fault_shows_at_the_sdk_and_passes(port, chain, fault, result) -> None:
    chain.faults.add(1, fault, 1)
    assert P2.read4ByteTxRx(port, 1, 132)[1] == result
    assert P2.read4ByteTxRx(port, 1, 132) == (ticks(1), sdk.COMM_SUCCESS, 0)


def test_program_with_open_port_notices_the_unplugging(chain, tmp_path, monkeypatch) -> None:
    # The SDK spins while it waits, in this process: the emulator may be scheduled late.
    monkeypatch.setattr(sdk.port_handler, "LATENCY_TIMER", 1000)
    with PtyShell(chain, tmp_path / "bus") as shell:
        port = sdk.PortHandler(str(shell.link))
        assert port.openPort()
        shell.unplug()
        assert not shell.link.exists()
        with pytest.raises((termios.error, OSError)):
            P2.ping(port, 1)
        port.closePort()
        shell.plug_in()
        again = sdk.PortHandler(str(shell.link))
        assert again.openPort()
        assert P2.ping(again, 1)[1] == sdk.COMM_SUCCESS
        again.closePort()
