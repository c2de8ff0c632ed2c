"""An arm of Feetech servos as a `JointSource`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from bodyschema.drivers.feetech.config import BusConfig, FeetechConfig
from bodyschema.drivers.servos.bus import Answer, Request, spare_after
from bodyschema.drivers.servos.bus import Bus as ServoBus
from bodyschema.drivers.servos.channel import Channel as ServoChannel
from bodyschema.drivers.servos.channel import Sample
from bodyschema.drivers.servos.joints import ServoJoints
from bodyschema.drivers.servos.model import Model, Register
from bodyschema.drivers.servos.packets import BROADCAST, Packets, Status, summed, take_summed
from bodyschema.drivers.servos.scan import ServoProtocol
from bodyschema.drivers.servos.servo import IdentifiedServo
from bodyschema.drivers.servos.settings import (
    BAUD,
    HOMING_OFFSET,
    ID,
    LARGEST_ID,
    OTHER_RATE,
    OTHER_ZERO,
    RENAMED,
    Setting,
)
from bodyschema.drivers.servos.vendor import ReadMethod, ServoVendor, one_by_one

from .models import BAUDS, BY_NUMBER, HARDWARE_ERRORS, MODES, PING, READ, STS, SYNC_READ, WRITE


class FeetechPackets:
    """The protocol of all series, which differ only in the byte order of registers."""

    overhead, ping_size = 6, 0
    refusals, is_weak = 0xC0, True  # no servo sets these two bits
    # They answer READ at any Response Status Level.
    pinged_only = "answers PING but no READ: look at its cable and supply"

    def ping(self, id: int) -> bytes:
        return summed(id, PING)

    def read(self, id: int, address: int, size: int) -> bytes:
        return summed(id, READ, bytes((address, size)))

    def write(self, id: int, address: int, data: bytes) -> bytes:
        return summed(id, WRITE, bytes((address,)) + data)

    def sync_read(self, ids: Sequence[int], address: int, size: int) -> bytes:
        """Build SYNC_READ: all of `ids` answer, in this order."""
        return summed(BROADCAST, SYNC_READ, bytes((address, size, *ids)))

    def take(self, received: bytes | bytearray, at: int) -> Status | None:
        return take_summed(received, at)


LARGEST_POSITION = 30_719  # 7.5 turns
KNOWN_ERRORS = sum(HARDWARE_ERRORS)


class Channel(ServoChannel):
    """The answers of one servo since the bus was opened."""

    def _sample(self, answer: Answer) -> Sample | None:
        data, model = answer.status.data, self.servo.model
        layout = model.layout

        def reported(name: str) -> int:
            return layout.value(name, data, layout.block.address)

        position, moving = reported("position"), reported("moving")
        if moving > 1 or reported("status") & ~KNOWN_ERRORS or not self._is_possible(position):
            return None
        if not self._is_steady(reported("voltage"), reported("temperature")):
            return None
        amperes = None if model.current_unit is None else reported("current") * model.current_unit
        return Sample(
            request_key=self.request_key(answer),
            expected=answer.earliest,
            earliest=answer.earliest,
            latest=answer.latest,
            ticks=position,
            velocity=reported("velocity") * model.velocity_unit,
            current=amperes,
            moving=bool(moving),
            alert=answer.status.error != 0,
        )

    def _is_possible(self, position: int) -> bool:
        if self.servo.model.ticks_per_turn is None:
            return 0 <= position < 2 * self.servo.model.zero_ticks
        return abs(position) <= LARGEST_POSITION


FARTHEST_OFFSET = 2047


def settings_of(model: Model) -> Sequence[Setting]:
    """Return the settings of a model, in the order of their addresses."""
    found = [*_common(model), *(_of_sts(model) if model.protocol == STS else ())]
    return sorted(found, key=lambda setting: setting.register.address)


def _common(model: Model) -> Iterator[Setting]:
    layout, order = model.layout, model.layout["model"].order
    farthest = (model.ticks_per_turn or 1024) - 1
    yield Setting(ID, layout["id"], 0, LARGEST_ID, follows=RENAMED)
    yield Setting(BAUD, layout["baud"], 0, 7, {str(b): place for place, b in enumerate(BAUDS)}, follows=OTHER_RATE)
    yield Setting("return_delay", layout["return_delay"], 0, 254, per_unit=2, unit="µs")
    # With 0 it answers reads but no writes.
    yield Setting("status_return", layout["status_return"], 0, 1)
    yield Setting("min_position_limit", Register(9, 2, order=order), 0, farthest)
    yield Setting("max_position_limit", Register(11, 2, order=order), 0, farthest)
    yield Setting("temperature_limit", Register(13, 1), 0, 100, unit="°C")
    yield Setting("max_voltage_limit", Register(14, 1), 0, 254, per_unit=0.1, unit="V")
    yield Setting("min_voltage_limit", Register(15, 1), 0, 254, per_unit=0.1, unit="V")
    yield Setting("max_torque", Register(16, 2, order=order), 0, 1000, per_unit=0.1, unit="%")
    phase = f"its maker calls it Phase: not without their manual. {OTHER_ZERO}"
    yield Setting("drive_mode", layout["drive_mode"], 0, 254, follows=phase)
    yield Setting("unloading", layout["unloading"], 0, 254, follows="which troubles switch its torque off")
    yield Setting("alarm_led", Register(20, 1), 0, 254)


def _of_sts(model: Model) -> Iterator[Setting]:
    layout, degrees = model.layout, math.degrees(model.rad_per_tick)
    homing = (layout["homing_offset"], -FARTHEST_OFFSET, FARTHEST_OFFSET)
    yield Setting("protection_current", Register(28, 2), 0, 511, per_unit=model.current_unit or 1.0, unit="A")
    yield Setting(HOMING_OFFSET, *homing, per_unit=degrees, unit="°", follows=OTHER_ZERO)
    modes = "in step mode the position is not the joint's"
    yield Setting("operating_mode", layout["operating_mode"], 0, 3, MODES, follows=modes)
    yield Setting("protective_torque", Register(34, 1), 0, 100, unit="%")
    yield Setting("overload_torque", Register(36, 1), 0, 100, unit="%")


PACKETS = FeetechPackets()
SYNC_READ_FAILED = (
    "Sync Read was not answered by all its servos: they are read one by one, which is slower. "
    "Look at cable and connectors; it is tried again every 10 s"
)


class Bus(ServoBus):
    """Feetech servos behind one port."""

    @staticmethod
    def packets_of(protocol: int) -> Packets:
        """Return the packet codec, which is the same for all series."""
        del protocol
        return PACKETS


def read_methods_of(bus: ServoBus, servos: Sequence[IdentifiedServo], config: BusConfig) -> list[list[ReadMethod]]:
    """Return the read methods of each group: the STS and SMS series, which support Sync Read, and the others."""
    sync_read = [servo for servo in servos if servo.model.protocol == STS]
    if len(sync_read) < 2 or config.sync_read != "auto":
        return [[one_by_one(bus, servos)]]
    alone = [servo for servo in servos if servo.model.protocol != STS]
    layout, ids = sync_read[0].model.layout, tuple(servo.id for servo in sync_read)
    block = layout.block

    def packet(size: int) -> bytes:
        return PACKETS.sync_read(ids, block.address, size)

    request = Request(packet, ids, block.size, STS, spare_after(layout, block))
    groups = [[ReadMethod("Sync Read", (request,), SYNC_READ_FAILED), one_by_one(bus, sync_read)]]
    return [*groups, [one_by_one(bus, alone)]] if alone else groups


FEETECH = ServoVendor(FeetechConfig.table, BY_NUMBER, HARDWARE_ERRORS, Bus, Channel, read_methods_of, settings_of, -1)


class FeetechJoints(ServoJoints):
    """An arm of Feetech servos with torque off as a `JointSource`; see `ServoJoints`."""

    vendor = FEETECH


FEETECH_SERVOS = ServoProtocol(
    name="Feetech", bauds=BAUDS, version=STS, models=BY_NUMBER, errors=HARDWARE_ERRORS, bus=Bus
)
