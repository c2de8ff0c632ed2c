"""An arm of Dynamixel servos as a `JointSource`."""

from __future__ import annotations

from collections.abc import Sequence

from bodyschema.drivers.serial_line import adapter_latency_s
from bodyschema.drivers.servos.drive import Drive
from bodyschema.drivers.servos.joints import OpenPort, ServoJoints
from bodyschema.drivers.servos.make import Make
from bodyschema.drivers.servos.port import Port
from bodyschema.interfaces.protocols import Clock

from .bus import Bus
from .channel import Channel
from .config import BusConfig, DynamixelConfig
from .models import BY_NUMBER, HARDWARE_ERRORS, TICK_S
from .plan import ways_of
from .port import SafePort
from .settings import settings_of


def open_serial(config: BusConfig, clock: Clock) -> tuple[Port, float]:
    """Open the port of a bus; return it and the latency of its adapter [s]."""
    latency_s = adapter_latency_s(config.port) if config.latency_ms is None else config.latency_ms * 1e-3
    port = SafePort(config.port, config.baud, latency_s=latency_s, now=clock.now)
    port.openPort()
    return port, latency_s


DYNAMIXEL = Make(
    DynamixelConfig.table,
    BY_NUMBER,
    HARDWARE_ERRORS,
    Bus,
    Channel,
    ways_of,
    settings_of,
    1,
    TICK_S,
)


class DynamixelJoints(ServoJoints):
    """An arm of Dynamixel servos as a `JointSource`; see `ServoJoints`."""

    def __init__(
        self,
        config: DynamixelConfig,
        joints: Sequence[str],
        clock: Clock,
        *,
        limits: Sequence[tuple[float, float]] | None = None,
        last_pose: Sequence[float] | None = None,
        open_port: OpenPort = open_serial,
        drives: Sequence[Drive] = (),
    ) -> None:
        """Prepare without opening anything; arguments as in `ServoJoints`."""
        super().__init__(
            DYNAMIXEL, config, joints, clock, open_port=open_port, limits=limits, last_pose=last_pose, drives=drives
        )
