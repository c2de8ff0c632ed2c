"""An arm of Feetech servos as a `JointSource`."""

from __future__ import annotations

from collections.abc import Sequence

from bodyschema.drivers.serial_line import SerialLine, adapter_latency_s
from bodyschema.drivers.servos.bus import Bus as ServoBus
from bodyschema.drivers.servos.bus import Request, spare_after
from bodyschema.drivers.servos.handshake import FittedServo
from bodyschema.drivers.servos.joints import OpenPort, ServoJoints
from bodyschema.drivers.servos.make import Make
from bodyschema.drivers.servos.packets import Packets
from bodyschema.drivers.servos.plan import Way
from bodyschema.drivers.servos.port import Port
from bodyschema.interfaces.protocols import Clock

from .channel import Channel
from .config import BusConfig, FeetechConfig
from .models import BY_NUMBER, HARDWARE_ERRORS, STS
from .packets import FeetechPackets
from .settings import settings_of

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


def open_serial(config: BusConfig, clock: Clock) -> tuple[Port, float]:
    """Open the port of a bus; return it and the latency of its adapter [s]."""
    latency_s = adapter_latency_s(config.port) if config.latency_ms is None else config.latency_ms * 1e-3
    return SerialLine.open(config.port, config.baud, clock.now), latency_s


def ways_of(bus: ServoBus, servos: Sequence[FittedServo], config: BusConfig) -> list[list[Way]]:
    """Return the read methods of each group: the STS and SMS series, which support Sync Read, and the others."""
    together = [servo for servo in servos if servo.model.protocol == STS]
    if len(together) < 2 or config.sync_read != "auto":
        return [[_one_by_one(bus, servos)]]
    alone = [servo for servo in servos if servo.model.protocol != STS]
    groups = [[_sync_read(together), _one_by_one(bus, together)]]
    return [*groups, [_one_by_one(bus, alone)]] if alone else groups


def _sync_read(servos: Sequence[FittedServo]) -> Way:
    layout, ids = servos[0].model.layout, tuple(servo.id for servo in servos)
    block = layout.block

    def packet(size: int) -> bytes:
        return PACKETS.sync_read(ids, block.address, size)

    request = Request(packet, ids, block.size, STS, spare_after(layout, block))
    return Way("Sync Read", (request,), SYNC_READ_FAILED)


def _one_by_one(bus: ServoBus, servos: Sequence[FittedServo]) -> Way:
    requests = (bus.read_request(servo.model, servo.id, servo.model.layout.block) for servo in servos)
    return Way("one by one", tuple(requests))


FEETECH = Make(FeetechConfig.table, BY_NUMBER, HARDWARE_ERRORS, Bus, Channel, ways_of, settings_of, -1)


class FeetechJoints(ServoJoints):
    """An arm of Feetech servos with torque off as a `JointSource`; see `ServoJoints`."""

    def __init__(
        self,
        config: FeetechConfig,
        joints: Sequence[str],
        clock: Clock,
        *,
        limits: Sequence[tuple[float, float]] | None = None,
        last_pose: Sequence[float] | None = None,
        open_port: OpenPort = open_serial,
    ) -> None:
        """Prepare without opening anything; arguments as in `ServoJoints`."""
        super().__init__(FEETECH, config, joints, clock, open_port=open_port, limits=limits, last_pose=last_pose)
