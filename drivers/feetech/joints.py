"""An arm of Feetech servos as a `JointSource`."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.serial_line import SerialLine, adapter_latency_s
from drivers.servos.bus import Bus as ServoBus
from drivers.servos.bus import Request
from drivers.servos.handshake import FittedServo
from drivers.servos.joints import OpenPort, ServoJoints
from drivers.servos.make import Make
from drivers.servos.packets import Packets
from drivers.servos.port import Port
from interfaces.protocols import Clock

from .channel import Channel
from .config import BusConfig, FeetechConfig
from .models import BY_NUMBER, HARDWARE_ERRORS, STS
from .packets import FeetechPackets
from .settings import settings_of

PACKETS = FeetechPackets()


class Bus(ServoBus):
    """Feetech servos behind one port."""

    @staticmethod
    def packets_of(protocol: int) -> Packets:
        """How to speak to any series."""
        del protocol
        return PACKETS


def open_serial(config: BusConfig, clock: Clock) -> tuple[Port, float]:
    """The open port of a bus, and the latency of its adapter [s]."""
    latency_s = adapter_latency_s(config.port) if config.latency_ms is None else config.latency_ms * 1e-3
    return SerialLine.open(config.port, config.baud, clock.now), latency_s


def block_requests(bus: ServoBus, servos: Sequence[FittedServo], config: BusConfig) -> list[Request]:
    """The questions of one reading: one for all of the STS and SMS series, one for each of the others."""
    together = [servo for servo in servos if servo.model.protocol == STS]
    if len(together) > 1 and config.sync_read == "auto":
        block, ids = together[0].model.layout.block, tuple(servo.id for servo in together)
        sync = Request(PACKETS.sync_read(ids, block.address, block.size), ids, block.size, STS)
        if bus.ask(sync).trouble is None:
            alone = [servo for servo in servos if servo.model.protocol != STS]
            return [sync, *(_block_request(bus, servo) for servo in alone)]
    return [_block_request(bus, servo) for servo in servos]


def _block_request(bus: ServoBus, servo: FittedServo) -> Request:
    return bus.read_request(servo.model, servo.id, servo.model.layout.block)


FEETECH = Make(
    FeetechConfig.table, BY_NUMBER, HARDWARE_ERRORS, Bus, Channel, "Feetech's FD", block_requests, settings_of, -1
)


class FeetechJoints(ServoJoints):
    """Reads the positions of an arm of Feetech servos whose torque is off; see `ServoJoints`."""

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
        """Nothing is opened yet; arguments as of `ServoJoints`."""
        super().__init__(FEETECH, config, joints, clock, open_port=open_port, limits=limits, last_pose=last_pose)
