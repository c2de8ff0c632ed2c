"""Arms of emulated Dynamixel servos in virtual time, and the instructions that they received."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from servo_arm import Path, ServoArm
from virtual_port import VirtualPort

from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.frames import Code, instructions_in
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME


class HeardPort(VirtualPort):
    """A port that records what is sent."""

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.heard = []

    def write(self, data: bytes) -> None:
        self.heard += instructions_in(bytearray(data))[0]
        super().write(data)

    def writes(self) -> list[tuple[int, bytes]]:
        """Return address and data of all writes to servos."""
        wide = {1: 1, 2: 2}
        told = [i for i in self.heard if i.code in (Code.WRITE, Code.REG_WRITE, Code.SYNC_WRITE, Code.BULK_WRITE)]
        return [(int.from_bytes(i.params[: wide[i.protocol]], "little"), i.params[wide[i.protocol] :]) for i in told]


class Arm(ServoArm):
    """A driver of Dynamixel servos on an emulator."""

    def __init__(
        self,
        models: Sequence[str] = ("XM430-W350",) * 3,
        paths: Sequence[Path] | None = None,
        *,
        latency_s: float = 0.0,
        held_s: float = 0.0,
        delay_s: float = 0.0,
        seed: int = 0,
        fast: Literal["auto", "never"] = "auto",
        limits: Sequence[tuple[float, float]] | None = None,
        last_pose: Sequence[float] | None = None,
        **settings,
    ) -> None:
        def servo(model: str, id: int, path: Path) -> Servo:
            return Servo(BY_NAME[model], id, path, return_delay_s=delay_s, booted_s=id * 0.1234)

        wire = {"latency_s": latency_s, "held_s": held_s, "seed": seed}
        super().__init__(models, paths, servo=servo, chain=Chain, port=HeardPort, **wire)
        buses = {"arm": BusConfig("emulator", fast_sync_read=fast)}
        self.config = DynamixelConfig(buses, self.entries(ServoConfig), **settings)
        self.driven(DynamixelJoints, self.config, limits=limits, last_pose=last_pose)
